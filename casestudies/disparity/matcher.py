"""The matcher, which computes disparity images from stereo pairs with the boards.

left and right image ─▶ filters, matching costs ─▶ tiles of likelihoods ─▶ stack, boards
disparity image ◀── most probable disparities ◀── posteriors of a tile ◀── /bm/frame, /BMresults
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray

from bridge.client import Message, Ros, connect
from bridge.errors import TopicLeftOutError
from bridge.stamps import header, header_stamp_ns
from casestudies import DEFAULT_URI, FirstTimeout, Timeout, Uri
from casestudies.disparity.comparison import HEADING, Matched, draw
from casestudies.disparity.images import (
    DISPARITY_TYPE,
    IMAGE_TYPE,
    BadImageError,
    ImagePairs,
    StereoImages,
    disparity_message,
    read_image,
)
from casestudies.disparity.matching import FILTERS, as_bytes, fused, likelihoods, matching_costs
from casestudies.disparity.model import (
    DISPARITIES,
    DISPARITY_TOPIC,
    LEFT_TOPIC,
    PIXELS,
    RIGHT_TOPIC,
    TILE_TOPIC,
    TILE_TYPE,
    TRUTH_TOPIC,
)
from casestudies.disparity.scene import BASELINE
from casestudies.topics import LossyPublication, connected, report_refused, run_viewer
from posteriors.errors import BadResultError, NoResultError
from posteriors.listening import Posteriors, posteriors
from posteriors.posterior import Posterior
from terminal.command_line import CommandLine
from terminal.connection import report_connection
from terminal.output import check_writable, say, warn

WINDOW: Final = 8
"""Maximum number of sent tiles without an answer.

If several tiles are sent before the first answer arrives, the processes and the boards can work in parallel.
"""
PICTURE: Final = "disparity.png"
_REPEAT_S: Final = 2.0
"""Seconds without a result after which the tiles that are not answered yet are sent again."""
_SILENT_S: Final = 5.0
"""Seconds without a pair after which the matcher says which camera is silent."""


def tiles_of(codes: NDArray[np.uint8], pixels: int) -> NDArray[np.uint8]:
    """Return the codes of an image as tiles, uint8[tiles, filters, pixels, disparities].

    `codes` has the shape [filters, disparities, height, width]. The last tile is filled up with pixels whose
    likelihoods are all 255. The machines of the added pixels stop first.
    """
    filters, disparities = codes.shape[:2]
    flat = codes.reshape(filters, disparities, -1)
    padded = np.pad(flat, ((0, 0), (0, 0), (0, -flat.shape[2] % pixels)), constant_values=255)
    return np.ascontiguousarray(padded.reshape(filters, disparities, -1, pixels).transpose(2, 0, 3, 1))


class Stack:
    """The running stack of master and boards, which computes posteriors from the matcher's likelihoods."""

    def __init__(
        self, tiles: LossyPublication, heard: Posteriors, ros: Ros, *, first_limit_s: float, limit_s: float
    ) -> None:
        self._tiles = tiles
        self._heard = heard
        self._ros = ros
        self._limits_s = first_limit_s, limit_s
        # True from the first result on. Until then only one tile is sent: the master may be absent, or its boards not
        # programmed yet, and what is sent again meanwhile must not fill the master's queue.
        self._answers = False

    async def posteriors(self, tiles: NDArray[np.uint8]) -> tuple[NDArray[np.float64], int]:
        """Send the tiles of an image, uint8[tiles, filters, pixels, disparities], and wait for the posteriors.

        A tile and its result have the same stamp. Late results of an earlier image are skipped.

        Returns:
            The posteriors, float64[tiles, pixels, disparities], and the sum of the cycles of all tiles.

        Raises:
            NoResultError: No result arrived in time.
            BadResultError: A posterior does not have the size of a tile.
        """
        count, _, pixels, disparities = tiles.shape
        found = np.zeros((count, pixels, disparities))
        first_ns = time.time_ns()
        waiting: set[int] = set()  # stamps of the tiles under way
        sent = cycles = 0
        newest = time.monotonic()  # result
        while sent < count or waiting:
            while sent < count and len(waiting) < (WINDOW if self._answers else 1):
                waiting.add(first_ns + sent)
                await self._send(first_ns + sent, tiles[sent])
                sent += 1
            limit_s = self._limits_s[self._answers]
            try:
                outcome = await self._heard.next_frame(min(limit_s, _REPEAT_S))
            except NoResultError:
                if time.monotonic() - newest >= limit_s:
                    raise await self._heard.no_result_error(limit_s) from None
                for stamp_ns in waiting:
                    await self._send(stamp_ns, tiles[stamp_ns - first_ns])
                continue
            newest, self._answers = time.monotonic(), True
            report = outcome.report if isinstance(outcome, Posterior) else outcome
            if report is None or report.stamp_ns not in waiting:
                continue
            waiting.remove(report.stamp_ns)
            cycles += report.cycles or 0
            if isinstance(outcome, Posterior):
                if outcome.sizes != (pixels, disparities):
                    raise BadResultError(
                        f"a posterior of {' x '.join(map(str, outcome.sizes))} values came, expected {pixels} pixels x "
                        f"{disparities} disparities: give --pixels and --disparities as the deployment was built"
                    )
                found[report.stamp_ns - first_ns] = outcome.values
        return found, cycles

    async def _send(self, stamp_ns: int, tile: NDArray[np.uint8]) -> None:
        likely = {name: each.tobytes() for name, each in zip(FILTERS, tile, strict=True)}
        await self._tiles.publish({"header": header(stamp_ns, "", self._ros.ros_version), **likely})


class Matcher:
    """Received stereo images, and the disparities that the machines compute from the images.

    Attributes:
        matched: The newest pair with its posteriors, for the picture. None before the first pair.
        pairs: Number of matched pairs.
    """

    def __init__(self, *, disparities: int, pixels: int, clock: float) -> None:
        self.matched: Matched | None = None
        self.pairs = 0
        self._disparities = disparities
        self._pixels = pixels
        self._clock = clock
        # Set by the tasks that follow the topics: the newest pair, which `next_pair` takes away, and the newest truths.
        self._images = ImagePairs()
        self._newest: StereoImages | None = None
        self._news = asyncio.Event()
        self._truths: deque[tuple[int | None, NDArray[Any]]] = deque(maxlen=64)
        self._warned: set[str] = set()

    def _warn_once(self, sentence: str, of: str = "") -> None:
        """Warn once about the topic `of`; without a topic, print each sentence once."""
        if (key := of or sentence) not in self._warned:
            self._warned.add(key)
            warn(sentence)

    def take_image(self, side: int, message: Message) -> None:
        """Take an image of the left (`side` 0) or right (1) camera. The first unusable image of a topic is reported."""
        try:
            pair = self._images.add(side, message.msg)
        except BadImageError as error:
            self._warn_once(f"an image on {message.topic} is skipped: {error}", message.topic)
            return
        if pair is not None:
            self._newest = pair
            self._news.set()

    def take_truth(self, message: Message) -> None:
        """Take an image of true disparities. Only the first unusable image is reported."""
        try:
            self._truths.append((header_stamp_ns(message.msg), read_image(message.msg, "32FC1")))
        except BadImageError as error:
            self._warn_once(f"an image on {message.topic} is skipped: {error}", message.topic)

    async def next_pair(self, limit_s: float) -> StereoImages:
        """Return the newest pair not returned before, or wait for a pair. Raises a NoResultError if none comes."""
        end = time.monotonic() + limit_s
        while self._newest is None:
            self._news.clear()
            try:
                async with asyncio.timeout(min(_SILENT_S, end - time.monotonic())):
                    await self._news.wait()
            except TimeoutError:
                sentence = self._images.silence(LEFT_TOPIC, RIGHT_TOPIC)
                if time.monotonic() >= end:
                    raise NoResultError(f"no pair of images within {limit_s:g} s: {sentence}") from None
                self._warn_once(sentence)
        pair, self._newest = self._newest, None
        return pair

    async def match(self, images: StereoImages, stack: Stack) -> Matched:
        """Match a pair on the host and on the boards."""
        begin = time.monotonic()
        # in a thread: a large pair takes seconds
        likely, tiles, host_s = await asyncio.to_thread(self._on_host, images)
        found, cycles = await stack.posteriors(tiles)
        total_s = time.monotonic() - begin
        height, width = images.left.shape
        rows = found.reshape(-1, self._disparities)[: height * width]
        return Matched(
            left=images.left,
            truth=next((truth for stamp_ns, truth in self._truths if stamp_ns == images.stamp_ns), None),
            exact=fused(likely),
            posterior=rows.T.reshape(self._disparities, height, width),
            host_s=host_s,
            total_s=total_s,
            boards_s=cycles / self._clock,
            cycles=cycles,
        )

    def _on_host(self, images: StereoImages) -> tuple[NDArray[np.float32], NDArray[np.uint8], float]:
        """Return the likelihoods, their tiles, and the seconds of CPU that they took."""
        begin = time.thread_time()
        likely = likelihoods(matching_costs(images.left, images.right, self._disparities))
        tiles = tiles_of(as_bytes(likely), self._pixels)
        return likely, tiles, time.thread_time() - begin

    async def watch(
        self,
        uri: str,
        stack_uri: str,
        as_message: Callable[..., dict[str, Any]],
        *,
        count: int | None,
        first_limit_s: float,
        limit_s: float,
    ) -> None:
        """Match pairs of images, and print a line for each pair.

        The method ends after `count` pairs. If `count` is None, it runs until it is cancelled.
        `as_message` is the function `disparity_message`, with the arguments about the cameras filled in.

        Raises:
            NoResultError: No pair of images, or no posterior, came in time.
            BadResultError: A message was not a result.
            BridgeError: No rosbridge server answers at a URI.
        """
        async with (
            connected("disparity-matcher", "a pair was matched", uri) as (ros, readiness),
            connect(stack_uri, retry=True, on_state=report_connection(stack_uri)) as boards,
            posteriors(boards, queue_size=256, compression="cbor") as heard,
        ):
            version = await ros.detect_ros_version()
            disparities = LossyPublication(await ros.advertise(DISPARITY_TOPIC, DISPARITY_TYPE))
            tiles = LossyPublication(await boards.advertise(TILE_TOPIC, TILE_TYPE))
            stack = Stack(tiles, heard, boards, first_limit_s=first_limit_s, limit_s=limit_s)
            tasks = [
                asyncio.create_task(_follow(ros, LEFT_TOPIC, partial(self.take_image, 0))),
                asyncio.create_task(_follow(ros, RIGHT_TOPIC, partial(self.take_image, 1))),
                asyncio.create_task(_follow(ros, TRUTH_TOPIC, self.take_truth)),
                asyncio.create_task(
                    report_refused(boards, TILE_TOPIC, TILE_TYPE, "name a hub with --stack-uri")
                ),
            ]
            say(f"disparity-matcher: listening to {uri}")
            print(HEADING, flush=True)
            try:
                while count is None or self.pairs < count:
                    images = await self.next_pair(limit_s if self.pairs else first_limit_s)
                    self.matched = await self.match(images, stack)
                    self.pairs += 1
                    message = as_message(self.matched.disparity, images.head, ros_version=version)
                    if await disparities.publish(message):
                        readiness.record()
                    print(self.matched.line(self.pairs), flush=True)
            finally:
                for task in tasks:
                    task.cancel()

    def finish(self, out: Path | None) -> None:
        """Print the newest pair's times beside the time in the thesis, and draw the pair into the folder `out`."""
        if self.matched is None:
            return
        print(self.matched.summary())
        if out is not None:
            draw(out / PICTURE, self.matched)
            print(f"wrote {out / PICTURE}")


async def _follow(ros: Ros, topic: str, take: Callable[[Message], None]) -> None:
    # a message that is too large for the connection ends the topic; the client has warned
    with contextlib.suppress(TopicLeftOutError):
        async for message in ros.subscribe(topic, IMAGE_TYPE, queue_size=2, compression="cbor"):
            take(message)


app = CommandLine()


@app.command(epilog="`disparity-matcher --uri ws://127.0.0.1:9090 --count 5 --out out`")
def disparity_matcher(
    uri: Uri = DEFAULT_URI,
    stack_uri: Annotated[
        str | None,
        typer.Option(
            help="The server of the stack, if it is not that of the cameras.",
            metavar="ws://HOST:PORT|robot:NAME",
            show_default="--uri",
        ),
    ] = None,
    count: Annotated[
        int | None, typer.Option(min=1, help="Exit after this many pairs.", show_default="at Ctrl-C")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help=f"Write {PICTURE}, of the last pair, into this folder.", file_okay=False),
    ] = None,
    disparities: Annotated[
        int, typer.Option(min=2, max=4096, help="Number of disparities, as in the deployment.")
    ] = DISPARITIES,
    pixels: Annotated[int, typer.Option(min=2, max=256, help="The deployment's --replicas.")] = PIXELS,
    baseline: Annotated[float, typer.Option(min=0, help="Distance of the cameras in metres.")] = BASELINE,
    focal: Annotated[
        float | None, typer.Option(min=1, help="Focal length in pixels.", show_default="an image's width")
    ] = None,
    clock: Annotated[
        float, typer.Option(min=1, help="Clock of real boards in Hz, for the projection.")
    ] = 100e6,
    first_timeout: FirstTimeout = 60.0,
    timeout: Timeout = 30.0,
) -> None:
    """Turn stereo pairs into disparity images with a stack whose boards hold a machine for each pixel of a tile.

    Left and right images are paired by their stamps. For each pair, print a line that compares the machines with
    float64 fusion. If true disparities are published, the line also compares both with the true disparities.
    """
    matcher = Matcher(disparities=disparities, pixels=pixels, clock=clock)
    if out is not None:
        check_writable(out)
    watching = matcher.watch(
        uri,
        stack_uri or uri,
        partial(disparity_message, disparities=disparities, focal_px=focal, baseline_m=baseline),
        count=count,
        first_limit_s=first_timeout,
        limit_s=timeout,
    )
    run_viewer(watching, partial(matcher.finish, out))


if __name__ == "__main__":
    app()
