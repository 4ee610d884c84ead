"""The Fibonacci action server for roslibpy's tests of ROS 2: one number of the sequence per step."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Final

from websockets.asyncio.client import ClientConnection, connect

from bridge.client.protocol.events import GoalStatus

STEP: Final = 0.3
"""Seconds per number: the tests cancel a goal of ten numbers after two seconds."""
ACTION: Final = {"action": "/fibonacci"}
TYPE: Final = "example_interfaces/action/Fibonacci"


@asynccontextmanager
async def fibonacci_server(uri: str) -> AsyncIterator[None]:
    """Serve the action on a rosbridge server."""
    async with connect(uri) as websocket:
        await websocket.send(json.dumps({"op": "advertise_action", "type": TYPE, **ACTION}))
        await websocket.send(json.dumps({"op": "call_service", "service": "/rosapi/get_time"}))
        await websocket.recv()  # the action is advertised
        serving = asyncio.ensure_future(_serve(websocket))
        try:
            yield
        finally:
            serving.cancel()


async def _serve(websocket: ClientConnection) -> None:
    goals: dict[str, asyncio.Task[None]] = {}
    async for message in websocket:
        operation: dict[str, Any] = json.loads(message)
        goal_id = operation["id"]
        if operation["op"] == "send_action_goal":
            goals[goal_id] = asyncio.ensure_future(_execute(websocket, goal_id, operation["args"]["order"]))
        elif operation["op"] == "cancel_action_goal":
            goals[goal_id].cancel()


async def _execute(websocket: ClientConnection, goal_id: str, order: int) -> None:
    sequence, status = [0, 1], GoalStatus.SUCCEEDED

    async def send(op: str, **more: Any) -> None:
        values = {"sequence": sequence}
        await websocket.send(json.dumps({"op": op, "id": goal_id, "values": values, **ACTION, **more}))

    try:
        while len(sequence) <= order:
            sequence.append(sequence[-1] + sequence[-2])
            await send("action_feedback")
            await asyncio.sleep(STEP)
    except asyncio.CancelledError:
        status = GoalStatus.CANCELED
    # As from the reference server, a cancelled goal has a result too.
    await send("action_result", status=status, result=True)
