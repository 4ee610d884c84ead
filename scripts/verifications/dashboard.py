"""Verification of the dashboard in a real browser, on a running stack (see scripts/verify).

Each check looks at pages in Debian's Chromium, and compares them with what a client of the same rosbridge server
receives. No page may report an error or request anything from another computer.
"""

import argparse
import asyncio
import contextlib
import csv
import io
import logging
import math
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, fields, replace
from typing import Final

import numpy as np

from bridge.client import Ros, connect
from bridge.stamps import header
from casestudies.boat.sensors import (
    SENSOR_NAMES,
    SET_POSE_TOPIC,
    TRUE_POSE_TOPIC,
    TRUE_POSE_TYPE,
    map_grid,
    read_set_pose,
    true_pose,
)
from posteriors import BoardReport, FrameReport, Posterior, StageTimes, posteriors
from posteriors.frame_report import FRAME_TOPIC, FRAME_TYPE, VariableReading, write_frame_report
from posteriors.posterior import RESULTS_TOPIC, RESULTS_TYPE
from scripts.running.browser import Browser, Place, Visit, browser
from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR, PRODUCT_LIMITS
from scripts.running.script import ROOT
from scripts.running.stand import PATIENCE, Stand, temporary_stand
from scripts.verifications.checks import CheckError, Tally, expect, within

LIMIT: Final = 1200.0 * FACTOR
"""Time limit of the verification, in seconds."""
NEAR: Final = 15.0
"""Maximum distance in map units of the posterior's mean from the boat, once the mean has followed the boat."""
START: Final[Place] = (0.0, -25.0)
"""Place in map units where the boat lies before it is dragged."""
GOALS: Final[tuple[Place, ...]] = ((0.55, 0.4), (0.3, 0.25), (0.65, 0.6))
"""Places where the boat is dropped, as shares of the canvas's width and height."""
PICTURES: Final = ROOT / "docs" / "pictures"
LARGEST: Final = 2_000_000
"""Maximum size of the animated picture, in bytes."""
POINTER: Final = ((0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12))
PHONE: Final = {"width": 390, "height": 844}
MARKERS: Final = ("/boat/beacons", "visualization_msgs/MarkerArray")
HOSTILE: Final = '<img src=x onerror="window.hostile=1">'
"""A name that would run code if it were taken for markup."""
NAMELESS: Final = """() => [...document.querySelectorAll('button, a[href], input, select, [role=img], canvas')]
    .filter(each => each.offsetParent && !(each.ariaLabel || each.innerText?.trim() || each.title
        || each.labels?.length || each.closest('[aria-label], [aria-hidden]')))
    .map(each => each.outerHTML.slice(0, 120))"""
"""Script that finds visible controls and pictures without a name for screen readers."""


@dataclass
class Scene:
    """The stack, the browser with a page that stays open, and what a client receives."""

    stand: Stand
    browser: Browser
    visit: Visit
    ros: Ros
    boat: Place = (math.nan, math.nan)
    """The boat's newest true position."""
    received: dict[int, Posterior] = field(default_factory=dict)
    """The posteriors by frame number."""
    news: asyncio.Condition = field(default_factory=asyncio.Condition)
    """Notified of each new position and posterior."""

    @property
    def newest(self) -> int:
        """The newest frame's number."""
        return max(self.received, default=0)

    async def follow_boat(self) -> None:
        """Receive positions until cancelled."""
        async for message in self.ros.subscribe(TRUE_POSE_TOPIC, TRUE_POSE_TYPE):
            self.boat = read_set_pose(message.msg)
            async with self.news:
                self.news.notify_all()

    async def follow_posteriors(self) -> None:
        """Receive posteriors until cancelled."""
        async for posterior in posteriors(self.ros):
            self.received[posterior.number or 0] = posterior
            async with self.news:
                self.news.notify_all()

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until a condition on the received messages holds, or raise a CheckError that names the condition."""
        async with within(PATIENCE, what), self.news:
            await self.news.wait_for(condition)

    async def put(self, x: float, y: float) -> None:
        """Move the boat to (x, y), where it stops sailing, and wait until it is there."""
        place = await self.ros.advertise(SET_POSE_TOPIC, TRUE_POSE_TYPE)
        await place.publish(true_pose(x, y, header(time.time_ns(), "map")))
        await self.until(lambda: math.dist(self.boat, (x, y)) < 1, f"the boat is not at {x:g}, {y:g}")

    async def dragged(self, visit: Visit, to: Place) -> None:
        """Drag the boat, and wait until the page and the stack have its posterior there, or raise a CheckError."""
        await self.put(*START)
        await visit.frame_above(self.newest)  # the page, too, shows the boat there
        await visit.drag(to)
        await visit.mean_near(to)
        await self.until(
            lambda: (
                math.dist(self.boat, START) > NEAR
                and math.dist(map_grid().mean(self.received[self.newest].probabilities), self.boat) < NEAR
            ),
            "the boat was not dragged away, or the posterior did not follow",
        )


async def check_live(scene: Scene) -> None:
    """Check that frame numbers rise, the posterior is painted, and readings with units, boards and times are there."""
    visit = scene.visit
    first = await visit.frame()
    await visit.until("first => window.paints.some(({number}) => number > first + 20)", first)
    for name in ("posterior", "stage-times"):
        colours = (await visit.picture(name)).getcolors(maxcolors=1 << 24)
        expect(len(colours or ()) > 10, f"{name} is painted with only the colours {colours}")
    for text in (*SENSOR_NAMES, " m\t", " deg\t"):
        await visit.text("readings", text)
    await visit.text("boards", "overflow")


async def check_names(scene: Scene) -> None:
    """Check that screen readers find a language, a title, and a name for each control and picture."""
    page = scene.visit.page
    expect(bool(await page.title()), "the page has no title")
    expect(bool(await page.evaluate("document.documentElement.lang")), "the page names no language")
    expect(not (found := await page.evaluate(NAMELESS)), f"without a name: {found}")


async def check_keyboard(scene: Scene) -> None:
    """Check that Tab reaches the controls, that Enter pauses and goes on, and that an arrow moves the boat."""
    visit, keyboard = scene.visit, scene.visit.page.keyboard
    for name, key in (("pause", "Enter"), ("posterior", "Shift+ArrowLeft")):
        for _ in range(80):
            await keyboard.press("Tab")
            if await visit.part(name).evaluate("part => part.contains(document.activeElement)"):
                break
        else:
            raise CheckError(f"Tab does not reach {name}")
        if name == "pause":
            await visit.pause(key=key)
            await visit.pause(key=key, state=False)
        else:
            await scene.put(*START)
            await visit.frame_above(scene.newest)
            await visit.boat()  # the page, too, has it there, and knows that it can be moved
            await keyboard.press(key)
            await scene.until(lambda: scene.boat[0] < START[0] - 5, "the arrow moved nothing")


async def check_phone(scene: Scene) -> None:
    """Check that a phone's page shows the posterior without scrolling to the side."""
    visit = await scene.browser.open(scene.stand.url, is_mobile=True, has_touch=True)
    await visit.page.set_viewport_size(PHONE)
    await visit.frame_above(await visit.frame())
    width = await visit.page.evaluate("document.documentElement.scrollWidth")
    expect(width <= PHONE["width"], f"the page is {width} pixels wide on a screen of {PHONE['width']}")
    box = await visit.part("posterior").bounding_box()
    expect(box["x"] >= 0 and box["x"] + box["width"] <= PHONE["width"], f"the posterior is at {box}")
    await visit.close()


async def check_schemes(scene: Scene) -> None:
    """Check that the page is dark where the system is, and light elsewhere."""
    mean = {}
    for scheme in ("dark", "light"):
        visit = await scene.browser.open(scene.stand.url, color_scheme=scheme)
        mean[scheme] = float(np.asarray((await visit.picture()).convert("L")).mean())
        await visit.close()
    expect(mean["dark"] + 50 < mean["light"], f"the mean lightness is {mean}")


async def check_two_browsers(scene: Scene) -> None:
    """Check that two browsers see the same run, and that a pause in one does not pause the other."""
    second = await scene.browser.open(scene.stand.url)
    await second.pause()
    stays = await second.frame()
    await scene.visit.frame_above(stays + 10)
    expect(await second.frame() == stays, "a paused page went on")
    await second.pause(state=False)
    await second.frame_above(stays + 10)
    await second.close()


async def check_steps(scene: Scene) -> None:
    """Check stepping from frame to frame on a paused page, and the files that it saves of the shown frame."""
    from PIL import Image

    visit = scene.visit
    await visit.pause()
    while (shown := await visit.frame()) - 1 not in scene.received:  # impossible readings have no posterior
        await visit.pause(state=False)
        await visit.pause()
    await scene.until(lambda: scene.newest > shown + 5, "no results came in a pause")
    expect(await visit.frame() == shown, "a paused page went on")
    for name, step in (("back", -1), ("back", -2), ("forward", -1)):
        await visit.part(f"step-{name}").click()
        await visit.text("frame-number", str(shown + step))
    posterior = scene.received[shown - 1]
    size = Image.open(io.BytesIO(await visit.saved("save-png"))).size
    expect(min(size) > 100, f"the saved picture has {size} pixels")
    with np.load(io.BytesIO(await visit.saved("save-npz"))) as arrays:
        (saved,) = arrays["probabilities"][arrays["frame"] == shown - 1]
        expect(np.allclose(saved, posterior.values), "the saved posterior is not that of its frame")
    rows = csv.DictReader(io.StringIO((await visit.saved("save-csv")).decode()))
    (row,) = (row for row in rows if row["frame"] == str(shown - 1))
    expect(
        math.isclose(float(row["probability"]), max(posterior.probabilities), rel_tol=1e-5),
        f"a saved row is {row}",
    )
    await visit.pause(state=False)
    await visit.frame_above(scene.newest)


async def check_drag(scene: Scene) -> None:
    """Drag the boat elsewhere with the mouse, and check that the posterior follows."""
    for goal in GOALS:
        await scene.dragged(scene.visit, goal)


async def check_switches(scene: Scene) -> None:
    """Check that a sensor that is unplugged on the page is marked as missing, until it is plugged in again."""
    for state in ("missing", "there"):
        await scene.visit.part("switch-D1-plugged").click()
        await scene.visit.until(
            "state => [...document.querySelectorAll('[data-testid=readings] tr')].some("
            "row => row.innerText.includes('D1') && row.innerText.includes('missing') === (state === 'missing'))",
            state,
        )


async def check_hub_returns(scene: Scene) -> None:
    """Check that the page says that the hub is away, and continues when it is back."""
    await scene.stand.kill("hub")
    await scene.visit.page.locator("[data-testid=connection].bm-bad").wait_for()
    await scene.stand.start("hub", r"ws://\S+")
    await scene.visit.page.locator("[data-testid=connection].bm-good").wait_for()
    await scene.visit.frame_above(await scene.visit.frame())


async def check_dashboard_returns(scene: Scene) -> None:
    """Check that an open page continues after a restart of the dashboard."""
    scene.visit.may_lose_server = True
    await scene.stand.kill("dashboard")
    await scene.visit.page.locator("[data-testid=connection].bm-bad").wait_for()
    await scene.stand.start("dashboard", r"http://\S+")
    await scene.visit.frame_above(scene.newest)
    scene.visit.may_lose_server = False


async def check_hostile(scene: Scene) -> None:
    """Check that names from topics are shown as text, and that the last frame looks old after the boat has ended."""
    visit, now = scene.visit, time.time_ns()
    await scene.stand.kill("simulator")
    await visit.page.locator("[data-testid=posterior].bm-old").wait_for()
    report = FrameReport(
        stamp_ns=now, received_ns=now, sent_ns=now, outcome=HOSTILE, deployment=HOSTILE, number=10**6, cycles=1,
        counts_total=1, link_bytes=1, link_transfers=1,
        stages=StageTimes(**{each.name: 1.0 for each in fields(StageTimes)}),
        boards=(BoardReport(name=HOSTILE, stopped=HOSTILE, cycles=1, counts_total=1),),
        missing=(HOSTILE,), readings={HOSTILE: VariableReading(HOSTILE, 1, 1.0)}, details={HOSTILE: HOSTILE},
    )  # fmt: skip
    unpublished = replace(report, published=False, number=10**6 + 1)
    layout = {"dim": [{"label": HOSTILE, "size": 4, "stride": 4}], "data_offset": 0}
    for (topic, type_), msg, shown in (
        (MARKERS, {"markers": [{"pose": {"position": {"x": 1.0, "y": 1.0}}, "text": HOSTILE}]}, None),
        ((FRAME_TOPIC, FRAME_TYPE), write_frame_report(report, 1), None),
        ((RESULTS_TOPIC, RESULTS_TYPE), {"layout": layout, "data": [0.25] * 4}, report.number),
        ((FRAME_TOPIC, FRAME_TYPE), write_frame_report(unpublished, 1), unpublished.number),
    ):
        await (await scene.ros.advertise(topic, type_)).publish(msg)
        if shown is not None:
            await visit.text("frame-number", str(shown))
            await visit.text("readings", HOSTILE)
    await visit.text("outcome", HOSTILE)
    ran = await visit.page.evaluate("window.hostile || document.querySelectorAll('img[src=x]').length")
    expect(not ran, "a name was taken for markup")


async def draw(scene: Scene) -> None:
    """Write the README's pictures: the page, and an animation of the drag."""
    from PIL import Image, ImageDraw

    visit = await scene.browser.open(scene.stand.url)
    await scene.dragged(visit, GOALS[0])
    await visit.frame_above(await visit.frame() + 50)
    (await visit.picture()).save(PICTURES / "dashboard.png", optimize=True)
    frames: list[Image.Image] = []

    async def take(pointer: Place) -> None:
        await visit.frame_above(await visit.frame() + 1)  # the first may be that of an earlier place
        picture = await visit.picture()
        arrow = [(pointer[0] + x, pointer[1] + y) for x, y in POINTER]  # browsers draw no pointer on pictures
        ImageDraw.Draw(picture).polygon(arrow, fill="white", outline="black")
        frames.append(picture.resize((picture.width * 3 // 4, picture.height * 3 // 4)))

    for goal in GOALS[::-1]:
        await visit.drag(goal, steps=10, each=take)
        for _ in range(5):
            await take(await visit.boat())
    path, (first, *others) = PICTURES / "dashboard-drag.webp", frames
    first.save(path, save_all=True, append_images=others, duration=150, loop=0, quality=70, method=6)
    expect(path.stat().st_size < LARGEST, f"{path} has {path.stat().st_size} bytes")
    await visit.close()


CHECKS: Final[dict[str, Callable[[Scene], Awaitable[None]]]] = {
    "live page": check_live,
    "names for screen readers": check_names,
    "keyboard": check_keyboard,
    "phone": check_phone,
    "dark and light": check_schemes,
    "two browsers": check_two_browsers,
    "pause, steps and files": check_steps,
    "drag": check_drag,
    "switches": check_switches,
    "the hub killed and started again": check_hub_returns,
    "the dashboard killed and started again": check_dashboard_returns,
    "pictures": draw,
    "hostile names": check_hostile,  # the last, because it ends the boat
}


async def verify(arguments: argparse.Namespace) -> int:
    """Start the stack and Chromium, and run the checks."""
    logging.getLogger("bridge").setLevel(logging.CRITICAL)  # the hub is killed on purpose
    os.environ |= {name: f"{limit:g}" for name, limit in PRODUCT_LIMITS.items()}
    tally = Tally()
    async with temporary_stand() as stand, browser() as chromium, contextlib.AsyncExitStack() as stack:
        await stand.start_hub()
        await stand.start_boat_master()
        await stand.start_boat()
        await stand.start_dashboard()
        ros = await stack.enter_async_context(connect(stand.uri, retry=True, check_types=False))
        scene = Scene(stand, chromium, await chromium.open(stand.url), ros)
        for follow in (scene.follow_boat, scene.follow_posteriors):
            stack.callback(asyncio.create_task(follow()).cancel)
        for name, check in CHECKS.items():
            if arguments.only in name and (arguments.pictures or check is not draw):
                await run_check(tally, name, check, scene)
        tally.report("no process has shown a traceback", time.monotonic(), stand.traceback())
    return tally.end()


async def run_check(tally: Tally, name: str, check: Callable[[Scene], Awaitable[None]], scene: Scene) -> None:
    """Run one check and report its result. The check also fails if the browser reports an error on a page."""
    started, why = time.monotonic(), None
    try:
        await check(scene)
    except Exception as error:  # those of Playwright, too, which can be imported only after its installation
        why = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
    for visit in scene.browser.visits:
        if visit.complaints:
            why = f"{why or 'no error'}; the browser reports {visit.complaints[:3]}"
            visit.complaints.clear()
    tally.report(name, started, why, scene.stand.tails() if why else "")


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify dashboard", __doc__)
    parser.flag("--only", "checks with this in their names", "")
    parser.switch("--pictures", "also draw docs/pictures/dashboard*")
    parser.run(verify, LIMIT)
