"""Debian's Chromium on the dashboard of a running stack, for `verify dashboard` and `bench dashboard`.

boat-simulator --> boat-normaliser --> hub <--> master with 4 boards
                                        ^
                                        v
                                    dashboard <--> pages in Chromium, which Playwright controls
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
import shutil
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from casestudies.demo import build
from scripts.running.patience import FACTOR
from scripts.verifications.installation import install_programs, use_packages
from terminal.processes import Process

if TYPE_CHECKING:
    from PIL import Image

LOCK: Final = Path(__file__).parents[1] / "verifications" / "playwright.lock"
PATIENCE: Final = 60.0 * FACTOR
"""Time limit of each wait, in seconds."""
TAIL: Final = 5
"""Number of the last lines of each log that are shown when a check fails."""
NUMBER: Final = "Number(document.querySelector('[data-testid=frame-number]')?.innerText.replace(/\\D/g, ''))"
"""The shown frame number, in JavaScript; 0 without one."""
NEAR: Final = 0.13
"""Distance from the posterior's mean to the boat up to which it has followed, as a share of the canvas's width: about
the posterior's own width.
"""
FOLLOW: Final = f"""
    window.paints = [];
    const now = () => performance.timeOrigin + performance.now();
    document.addEventListener('pointermove', ({{buttons}}) => {{ if (buttons) window.moved = now(); }}, true);
    const follow = canvas => new MutationObserver(() => {{
        const {{meanX, meanY}} = canvas.dataset;
        window.paints.push({{number: {NUMBER}, at: now(), x: Number(meanX), y: Number(meanY)}});
        if (window.paints.length > 10000) window.paints.shift();
    }}).observe(canvas, {{attributeFilter: ['data-at']}});
    new MutationObserver(() => {{
        const canvas = document.querySelector('[data-testid=posterior]');
        if (canvas && canvas !== window.followed) follow(window.followed = canvas);
    }}).observe(document, {{childList: true, subtree: true}});
"""
"""Script of each page: keeps the frames that were painted, with time and mean, and when the boat was last moved."""

Place = tuple[float, float]
Each = Callable[[Place], Awaitable[None]]


class Visit:
    """A page of the dashboard in a window of its own.

    Attributes:
        page: Playwright's page.
        complaints: Errors on the console, uncaught exceptions, and requests to other computers.
        may_lose_server: While the dashboard restarts, because the browser itself reports each failed request.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.may_lose_server = False
        page.set_default_timeout(1e3 * PATIENCE)
        page.on("console", self._take_line)
        page.on("pageerror", lambda error: self.complaints.append(f"exception: {error}"))
        page.on("request", lambda request: self._take_request(request.url))
        page.on("websocket", lambda socket: self._take_request(socket.url))

    def _take_line(self, line: Any) -> None:
        if line.type == "error" and not (self.may_lose_server and "ERR_" in line.text):
            self.complaints.append(f"console: {line.text}")

    def _take_request(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in {"data", "blob"} and parts.hostname != "127.0.0.1":
            self.complaints.append(f"request to {url}")

    def part(self, name: str) -> Any:
        """Return the element with a test id."""
        return self.page.get_by_test_id(name)

    async def until(self, condition: str, argument: Any = None) -> Any:
        """Wait until a JavaScript function of the argument returns something true, and return that."""
        found = await self.page.wait_for_function(condition, arg=argument, timeout=1e3 * PATIENCE)
        return await found.json_value()

    async def text(self, name: str, text: str) -> None:
        """Wait until the text of an element has another one in it."""
        await self.until(
            "([name, text]) => document.querySelector(`[data-testid=${name}]`)?.innerText.includes(text)",
            [name, text],
        )

    async def frame(self) -> int:
        """Return the shown frame number; 0 if there is none."""
        return int(await self.page.evaluate(NUMBER))

    async def frame_above(self, number: int) -> int:
        """Wait until a later frame is shown, and return its number."""
        return int(await self.until(f"number => {NUMBER} > number && {NUMBER}", number))

    async def pause(self, *, state: bool = True, key: str = "") -> None:
        """Pause or go on, by the mouse or by a key on the button, and wait until the page says so."""
        await (self.page.keyboard.press(key) if key else self.part("pause").click())
        await self.until(
            "state => document.querySelector('[data-testid=age]').innerText.includes('paused') === state",
            state,
        )

    async def picture(self, name: str = "") -> Image.Image:
        """Return a picture of the page, or of the element with a test id."""
        from PIL import Image

        of = self.part(name) if name else self.page
        return Image.open(io.BytesIO(await of.screenshot())).convert("RGB")

    async def saved(self, name: str) -> bytes:
        """Click on an element that saves a file, and return its content."""
        async with self.page.expect_download() as downloading:
            await self.part(name).click()
        return bytes(Path(await (await downloading.value).path()).read_bytes())  # noqa: ASYNC240 - a small file

    async def boat(self) -> Place:
        """Return where the boat is drawn on the page, in pixels."""
        await self.until("() => document.querySelector('.bm-draggable')?.dataset.boatX")
        data = await self.part("posterior").evaluate("canvas => [canvas.dataset.boatX, canvas.dataset.boatY]")
        box = await self.part("posterior").bounding_box()
        return box["x"] + float(data[0]), box["y"] + float(data[1])

    async def drag(self, to: Place, steps: int = 5, each: Each | None = None) -> float:
        """Move the boat with the mouse, and return when it reached its place, in milliseconds of the browser's clock.

        Args:
            to: Place as shares of the canvas's width and height.
            steps: Number of movements of the mouse.
            each: Awaited after each movement, with the place of the mouse on the page.
        """
        mouse, (x, y) = self.page.mouse, await self.boat()
        box = await self.part("posterior").bounding_box()
        to_x, to_y = box["x"] + to[0] * box["width"], box["y"] + to[1] * box["height"]
        await mouse.move(x, y)
        await mouse.down()
        for step in range(1, steps + 1):
            at = x + (to_x - x) * step / steps, y + (to_y - y) * step / steps
            await mouse.move(*at)
            if each is not None:
                await each(at)
        await mouse.up()
        return float(await self.page.evaluate("window.moved"))

    async def mean_near(self, to: Place) -> float:
        """Wait until a posterior was painted after that with its mean near; return when, in the browser's clock."""
        found = await self.until(
            """([x, y, near]) => {
                const {clientWidth, clientHeight} = document.querySelector('[data-testid=posterior]');
                return window.paints.find(paint => paint.at > window.moved && near * clientWidth
                    > Math.hypot(paint.x - x * clientWidth, paint.y - y * clientHeight))?.at;
            }""",
            [*to, NEAR],
        )
        return float(found)

    async def close(self) -> None:
        """Close the page."""
        await self.page.context.close()


class Browser:
    """Chromium, without a window on a screen, and the pages that were opened."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium
        self.visits: list[Visit] = []

    async def open(self, url: str, **options: Any) -> Visit:
        """Open a page in a context of its own, as a second browser would, and wait for its first frame."""
        context = await self._chromium.new_context(viewport={"width": 1280, "height": 900}, **options)
        await context.add_init_script(FOLLOW)
        visit = Visit(await context.new_page())
        self.visits.append(visit)
        await visit.page.goto(url)
        await visit.frame_above(0)
        return visit


@contextlib.asynccontextmanager
async def browser() -> AsyncIterator[Browser]:
    """Start Chromium, after installing what is missing.

    Raises:
        SettingsError: Chromium or Playwright is absent and cannot be installed.
    """
    install_programs({"chromium": "chromium"})
    use_packages("playwright", LOCK)
    from playwright.async_api import async_playwright

    async with async_playwright() as playwright:
        chromium = await playwright.chromium.launch(executable_path=shutil.which("chromium"))
        try:
            yield Browser(chromium)
        finally:
            await chromium.close()


class Stand:
    """The processes of a run and the dashboard; each can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        """Keep deployment, logs and sockets in a folder."""
        self._folder = folder
        (folder / "run").mkdir(parents=True, mode=0o700)
        self._where: tuple[str, ...] = ()
        self.uri = self.url = ""
        # The processes that were started and their command lines, so that they can be started again.
        self._commands: dict[str, tuple[str, ...]] = {}
        self._processes: dict[str, Process] = {}

    def pid(self, name: str) -> int:
        """Return the number of a process."""
        return self._processes[name].pid

    async def start(self, name: str, ready: str, *command: str) -> str:
        """Start a process, or start it again without a command, and return the text that shows its readiness."""
        self._commands[name] = command or self._commands[name]
        self._processes[name] = process = Process(name, self._folder / f"{name}.log")
        await process.start(*self._commands[name])
        async with asyncio.timeout(2 * PATIENCE):
            return (await process.line(ready))[0]

    async def kill(self, name: str) -> None:
        """Kill a process as a crash would, and wait for its end."""
        os.kill(self.pid(name), signal.SIGKILL)
        await self._processes[name].wait()

    async def start_hub(self, ros_version: str = "1") -> None:
        """Start the hub on a free port, on which it will also start again."""
        command = ("hub", "--ros-version", ros_version, "--port")
        self.uri = await self.start("hub", r"ws://\S+", *command, "0")
        self._commands["hub"] = (*command, str(urlsplit(self.uri).port))
        self._where = ("--uri", self.uri, "--run-directory", str(self._folder / "run"))

    async def start_master(self, extra: str = "") -> None:
        """Build the boat's deployment, add lines to its deployment.toml, and start its master."""
        await build("boat", deployment := self._folder / "boat", self.uri, SENSORS_TOPIC, SENSORS_TYPE)
        with (deployment / "deployment.toml").open("a") as file:
            file.write(extra)
        flags = ("-d", str(deployment), "--loop", *self._where)
        await self.start("master", "pcie-app: 4 boards", "master", *flags)

    async def start_boat(self, rate: float) -> None:
        """Start normaliser and simulator."""
        await self.start("normaliser", "boat", "boat-normaliser", "--uri", self.uri)
        flags = ("--uri", self.uri, "--rate", str(rate))
        await self.start("simulator", "seed", "boat-simulator", *flags)

    async def start_dashboard(self) -> None:
        """Start the dashboard on a free port, on which it will also start again."""
        command = ("dashboard", *self._where, "--port")
        self.url = await self.start("dashboard", r"http://[\w.:]+", *command, "0")
        self._commands["dashboard"] = (*command, str(urlsplit(self.url).port))

    def tails(self) -> str:
        """Return the last lines of the logs."""
        logs = {name: (self._folder / f"{name}.log").read_text() for name in self._processes}
        return "\n".join(f"    {name}: {line}" for name in logs for line in logs[name].splitlines()[-TAIL:])

    def traceback(self) -> str | None:
        """Return which processes have shown a traceback; None if none has."""
        names = [
            name for name in self._processes if "Traceback" in (self._folder / f"{name}.log").read_text()
        ]
        return f"there is one from {' and '.join(names)}" if names else None

    async def end(self) -> None:
        """End all processes."""
        await asyncio.gather(*(process.end() for process in self._processes.values()))
