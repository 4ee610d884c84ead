"""Debian's Chromium on the dashboard of a stand, for `verify dashboard` and `bench dashboard`."""

import contextlib
import io
import shutil
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from scripts.running.stand import PATIENCE
from scripts.verifications.installation import install_programs, use_packages

if TYPE_CHECKING:
    from PIL import Image

LOCK: Final = Path(__file__).parents[1] / "verifications" / "playwright.lock"
NUMBER: Final = "Number(document.querySelector('[data-testid=frame-number]')?.innerText.replace(/\\D/g, ''))"
"""The shown frame number, in JavaScript; 0 without one."""
NEAR: Final = 0.13
"""A posterior has followed the boat if the distance from its mean to the boat is below this value.

The unit is the width of the canvas. The value is about the width of the posterior.
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
    """A page of the dashboard in its own browser window.

    Attributes:
        page: The page as an object of Playwright.
        complaints: Errors on the console, uncaught exceptions, and requests to other computers.
        may_lose_server: Whether to ignore errors of failed requests, for example while the dashboard restarts.
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
        """Wait until a JavaScript function of the argument returns a truthy value, and return that value."""
        found = await self.page.wait_for_function(condition, arg=argument, timeout=1e3 * PATIENCE)
        return await found.json_value()

    async def text(self, name: str, text: str) -> None:
        """Wait until the content of an element contains this text."""
        await self.until(
            "([name, text]) => document.querySelector(`[data-testid=${name}]`)?.innerText.includes(text)",
            [name, text],
        )

    async def frame(self) -> int:
        """Return the shown frame number; 0 if there is none."""
        return int(await self.page.evaluate(NUMBER))

    async def frame_above(self, number: int) -> int:
        """Wait until a frame after `number` is shown, and return its number."""
        return int(await self.until(f"number => {NUMBER} > number && {NUMBER}", number))

    async def pause(self, *, state: bool = True, key: str = "") -> None:
        """Pause or go on, by the mouse or by a key on the button, and wait until the page says so."""
        await (self.page.keyboard.press(key) if key else self.part("pause").click())
        await self.until(
            "state => document.querySelector('[data-testid=age]').innerText.includes('paused') === state",
            state,
        )

    async def picture(self, name: str = "") -> "Image.Image":
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
        """Drag the boat with the mouse. Return the boat's time of arrival in milliseconds of the browser's clock.

        Args:
            to: Destination of the boat, as shares of the canvas's width and height.
            steps: Number of movements of the mouse.
            each: Coroutine function, called after each movement with the place of the mouse on the page.
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
        """Wait until, after a drag, the page paints a posterior with a mean near `to`.

        Returns the time of this paint by the browser's clock.
        """
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
    """Start Chromium, and close it at the end of the context.

    If Chromium or playwright is missing, install it first. Raises a SettingsError if the installation fails.
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
