"""roslibpy, the client that most Python users have, on the hub; `scripts/verify conformance` runs its own suites."""

import asyncio
import os
import sys
from pathlib import Path

import pytest

from tests.bridge.hub.sockets import running_hub
from tests.patience import PROCESS_PATIENCE

_SESSION = Path(__file__).with_name("roslibpy_session.py")


@pytest.mark.process
@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_session_of_roslibpy():
    async with running_hub() as port:
        session = await asyncio.create_subprocess_exec(
            *(sys.executable, str(_SESSION), str(port)),
            env={**os.environ, "ROSLIBPY_TRANSPORT": "asyncio"},
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            _nothing, complaints = await asyncio.wait_for(session.communicate(), PROCESS_PATIENCE)
        finally:
            if session.returncode is None:
                session.kill()
                await session.wait()
    assert session.returncode == 0, complaints.decode()
