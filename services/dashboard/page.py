"""The web application of the dashboard, with a page, a WebSocket and files.

/          the page: layout, buttons and choices
/live      WebSocket: sends messages of `View` to the browser, and receives new poses and switch settings
/frames.*  the kept frames as files
"""

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
from fastapi import FastAPI, Response, WebSocket, WebSocketDisconnect
from nicegui import ui
from nicegui.element import Element

from posteriors.axes import printable
from services.dashboard.feed import STAGES, Feed
from services.dashboard.robot import WatchedRobot
from services.dashboard.saving import archive, same_shape, table
from services.dashboard.view import View, choices, packed
from terminal.signals import until_one_ends

_STATS_EVERY: Final = 0.5
_OF_ROBOT: Final = ["state", "connected", "why", "boards", "landmarks", "switches", "can_set_pose", "samples"]
"""Attributes of the robot that are sent to the page unchanged."""
_IN_FLIGHT: Final = 2
"""Maximum number of unacknowledged messages to a browser; with more, the page would only show older frames."""
_HERE: Final = Path(__file__).parent
_MAX_INBOUND: Final = 4096
_MAX_ASKING: Final = 8
"""Maximum number of unanswered ROS service calls with which one browser sets the simulated world's switches."""


class Live(Element, component="live.js"):
    """The part of the page that changes with each frame. The script `live.js` draws it."""

    def __init__(self, view: str) -> None:
        super().__init__()
        self._props["view"] = view


class Wish(msgspec.Struct, frozen=True):
    """A request from a browser: to move the simulated boat to `pose`, or to turn a switch on or off."""

    pose: tuple[float, float] | None = None
    switch: str = ""
    on: bool = False


class Dashboard:
    """The page for any number of browsers."""

    def __init__(self, feed: Feed, robot: WatchedRobot) -> None:
        self._feed = feed
        self._robot = robot
        # The choices of each browser, by its number with the framework, which is also in the address of its socket.
        self._views: dict[str, View] = {}
        # The last statistics and when they were made (monotonic, s), because all browsers get the same ones.
        self._stats: tuple[float, bytes] = (0.0, b"")

    def application(self) -> FastAPI:
        """Return the web application. Call this only once in a process, because it sets up NiceGUI for the process."""
        application = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
        application.add_api_websocket_route("/live", self._live)
        application.add_api_route("/frames.{kind}", self._file)
        ui.page("/", title="rosbayes")(self._page)
        ui.run_with(
            application,
            title="rosbayes",
            dark=None,
            tailwind=False,
            binding_refresh_interval=None,
            show_welcome_message=False,
        )
        return application

    # The page

    def _page(self) -> None:
        client = ui.context.client
        view = self._views[client.id] = View(self._feed)
        # a function of ours, because the framework looks at its parameters
        client.on_delete(lambda: self._views.pop(client.id, None))
        ui.add_css(_HERE / "live.css")
        with ui.row().classes("items-center"):
            ui.label("rosbayes").classes("text-h6").props('role="heading" aria-level="1"')
            live: Live

            def pressed(act: Callable[[Any], None], how: Any) -> None:
                act(how)
                icon, purpose = ("play_arrow", "Continue") if view.at is not None else ("pause", "Pause")
                pause.props(f'icon={icon} aria-label="{purpose}"')

            def save_picture() -> None:
                live.run_method("savePng", "posterior.png")

            _button("One frame back", "step-back", lambda: pressed(view.step, -1), icon="skip_previous")
            pause = _button("Pause", "pause", lambda: pressed(view.pause, view.at is None), icon="pause")
            _button("One frame forward", "step-forward", lambda: pressed(view.step, 1), icon="skip_next")
            _button("Save the picture", "save-png", save_picture, text="PNG")
            for kind in ("npz", "csv"):
                save = partial(ui.download.from_url, f"/frames.{kind}?view={client.id}")
                _button(f"Save the frames as {kind.upper()}", f"save-{kind}", save, text=kind.upper())
            marginals = ui.select(
                {}, label="marginal", on_change=lambda event: view.choose(event.value or ())
            )
            marginals.props('dense options-dense data-testid=marginals aria-label="Marginal"').style(
                "width: 9rem"
            )
            dark = ui.dark_mode(value=None)
            _button("Light or dark", "dark", lambda: dark.set_value(not dark.value), icon="contrast")
        live = Live(client.id)

        def offer() -> None:
            """Offer the marginals of the newest posterior. The list is updated only if the marginals have changed."""
            frame = self._feed.newest
            labels = frame.searched if frame is not None else ()
            # the horizontal variable is named first, as in a position
            options = {each: " by ".join(map(printable, reversed(each))) for each in choices(labels)}
            if labels:  # a frame without a posterior has none
                marginals.set_visibility(len(labels) > 1)
            if labels and options != marginals.options:
                marginals.set_options(options, value=view.labels(frame) if frame is not None else None)

        ui.timer(1.0, offer)

    # The socket

    async def _live(self, socket: WebSocket, view: str = "") -> None:
        await socket.accept()
        room, changed = asyncio.Semaphore(_IN_FLIGHT), asyncio.Event()
        changed.set()
        self._feed.watchers.add(changed.set)
        writing = self._write(socket, self._views.get(view) or View(self._feed), room, changed)
        try:
            # in this order: the socket is closed, it sent bytes instead of text, or it closed during a message
            with suppress(WebSocketDisconnect, KeyError, RuntimeError):
                await until_one_ends(writing, self._read(socket, room))
        finally:
            self._feed.watchers.discard(changed.set)

    async def _read(self, socket: WebSocket, room: asyncio.Semaphore) -> None:
        asking: set[asyncio.Task[None]] = set()
        try:
            while True:
                text = await socket.receive_text()
                if text == ".":
                    room.release()
                elif (wish := _wish(text)) is None:
                    continue
                elif wish.pose is not None:
                    self._robot.set_pose(*wish.pose)
                elif len(asking) < _MAX_ASKING:
                    # a service may take seconds, in which the page goes on
                    task = asyncio.create_task(self._switch(socket, wish))
                    asking.add(task)
                    task.add_done_callback(asking.discard)
                else:
                    await socket.send_bytes(_notice("the switches before this one have not answered yet"))
        finally:
            for task in asking:
                task.cancel()

    async def _write(
        self, socket: WebSocket, view: View, room: asyncio.Semaphore, changed: asyncio.Event
    ) -> None:
        loop = asyncio.get_running_loop()
        sent: object = None
        next_stats = 0.0
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout_at(next_stats):
                    await changed.wait()
            changed.clear()
            if loop.time() >= next_stats:
                next_stats = loop.time() + _STATS_EVERY
                await room.acquire()
                await socket.send_bytes(self._statistics())
            await room.acquire()
            # looked up only now, because newer ones may have come during the wait for room
            frame = view.frame
            axes = self._robot.axes_for(frame) if frame is not None else ()
            now = (frame, view.at, frame and view.labels(frame), axes)
            if frame is None or now == sent:
                room.release()
                continue
            sent = now
            await socket.send_bytes(view.message(frame, axes, self._robot.words_for(frame)))

    def _statistics(self) -> bytes:
        now = time.monotonic()
        if now - self._stats[0] >= _STATS_EVERY / 2:
            head: dict[str, Any] = {name: getattr(self._robot, name) for name in _OF_ROBOT} | {
                "kind": "stats",
                "rate": self._feed.rate(now),
                "lost": {**self._feed.lost, **self._robot.lost},
                "truth": self._feed.truth,
                "last": self._feed.newest.at if self._feed.newest is not None else 0,
                "stage_names": STAGES,
                "stages": self._feed.stage_times(now),
            }
            self._stats = (now, packed(head))
        return self._stats[1]

    async def _switch(self, socket: WebSocket, wish: Wish) -> None:
        await socket.send_bytes(_notice(await self._robot.switch(wish.switch, wish.on)))

    # Files

    async def _file(self, kind: Literal["npz", "csv"], view: str = "") -> Response:
        shown = self._views.get(view) or View(self._feed)
        frames = same_shape(tuple(self._feed.frames), shown.frame)
        if not frames:
            return Response("there is no posterior yet\n", status_code=404, media_type="text/plain")
        axes = self._robot.axes_for(frames[0])
        make = partial(archive, frames, axes) if kind == "npz" else partial(table, frames)
        # in a thread, because it takes longer than the time between two frames
        content = await asyncio.to_thread(make)
        headers = {"Content-Disposition": f'attachment; filename="posteriors.{kind}"'}
        return Response(content, media_type="application/octet-stream", headers=headers)


def _notice(text: str) -> bytes:
    return packed({"kind": "notice", "text": text})


def _wish(text: str) -> Wish | None:
    """Return the request in a message from a browser; None if the message is not valid."""
    if len(text) > _MAX_INBOUND:
        return None
    try:
        return msgspec.json.decode(text, type=Wish)
    except (msgspec.MsgspecError, RecursionError):
        return None


def _button(
    purpose: str, test: str, act: Callable[[], object], *, text: str = "", icon: str | None = None
) -> ui.button:
    button = ui.button(text, icon=icon, on_click=act)
    button.props(f'flat dense data-testid={test} aria-label="{purpose}"').tooltip(purpose)
    return button
