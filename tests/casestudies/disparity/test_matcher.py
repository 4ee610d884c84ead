"""The matcher between a fake server's cameras and a stack that loses tiles, fails, or is of another size.

images -> fake server -> Matcher -> /disparity/likelihoods -> pretend stack -> /bm/frame, /BMresults -> Matcher
"""

import asyncio
import base64
import contextlib
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread

from bridge.stamps import header, stamp_ns
from casestudies.disparity import matcher as matcher_module
from casestudies.disparity.comparison import UNKNOWN, Matched, bad_share
from casestudies.disparity.images import disparity_message, image_message, read_image
from casestudies.disparity.matcher import Matcher
from casestudies.disparity.matching import FILTERS
from casestudies.disparity.model import LEFT_TOPIC, RIGHT_TOPIC, TILE_TOPIC, TRUTH_TOPIC
from casestudies.disparity.scene import Scene
from posteriors.errors import BadResultError, NoResultError
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE
from tests.posteriors.messages import report_message

PAIR = Scene(2).pair(0, 30, 20)
LIMITS = {"count": 1, "first_limit_s": PATIENCE, "limit_s": PATIENCE}
AS_MESSAGE = partial(disparity_message, disparities=16, focal_px=None, baseline_m=0.1)


def exact(tile):
    """The posterior of a tile's likelihoods, float64[pixels, disparities]."""
    columns = [np.frombuffer(base64.b64decode(tile[name]), np.uint8).reshape(-1, 16) for name in FILTERS]
    product = np.prod(np.array(columns, float), axis=0)
    return product / product.sum(axis=1, keepdims=True)


async def answer(fake, tile, posterior):
    """Publish the outcome of a tile as the publisher does; None is a frame without a posterior."""
    published = str(posterior is not None).lower()
    report = report_message(tile["header"]["stamp"], published=published, number=1, cycles=500)
    await fake.publish("/bm/frame", report)
    if posterior is not None:
        sizes = zip(("replica", "disparity"), posterior.shape, strict=True)
        dims = [{"label": label, "size": size, "stride": 1} for label, size in sizes]
        message = {"layout": {"dim": dims, "data_offset": 0}, "data": posterior.ravel().tolist()}
        await fake.publish("/BMresults", message)


@contextlib.asynccontextmanager
async def serving(fake, respond):
    """Call `respond(number, tile)` for each tile that comes, from 0."""

    async def serve():
        number = 0
        while True:
            await fake.wait_for_op("publish", topic=TILE_TOPIC, count=number + 1)
            await respond(number, fake.ops("publish", topic=TILE_TOPIC)[number]["msg"])
            number += 1

    task = asyncio.create_task(serve())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def publish_pair(fake, pair=PAIR, stamp=1_000_000_001, right=None):
    for topic in (LEFT_TOPIC, RIGHT_TOPIC, TRUTH_TOPIC):
        await fake.wait_for_op("subscribe", topic=topic)
    head = header(stamp, "left_camera", 2)
    truth = np.where(pair.occluded, np.nan, pair.disparity)
    messages = {
        TRUTH_TOPIC: image_message(truth, head, "32FC1"),
        LEFT_TOPIC: image_message(pair.left, head, "mono8"),
        RIGHT_TOPIC: right or image_message(pair.right, head, "mono8"),
    }
    for topic, message in messages.items():
        await fake.publish(topic, message | {"data": base64.b64encode(message["data"]).decode()})


async def run(respond, *, pixels=160, stamps=(1_000_000_001,), **limits):
    """Run a matcher over pairs on a fake server, and return it with the disparity images that it published."""
    matcher = Matcher(disparities=16, pixels=pixels, clock=1e8)
    async with FakeRosbridge() as fake, serving(fake, lambda *given: respond(fake, *given)):
        watching = asyncio.ensure_future(matcher.watch(fake.uri, fake.uri, AS_MESSAGE, **LIMITS | limits))
        try:
            for number, stamp in enumerate(stamps, 1):
                await publish_pair(fake, stamp=stamp)
                if number < len(stamps):
                    await fake.wait_for_op("publish", topic="/stereo/disparity", count=number)
            async with asyncio.timeout(PATIENCE):
                await watching
        finally:
            watching.cancel()
        return matcher, fake, [op["msg"] for op in fake.ops("publish", topic="/stereo/disparity")]


async def test_a_pair_becomes_a_disparity_image(tmp_path, capsys):
    async def respond(fake, number, tile):
        await answer(fake, tile, exact(tile))

    matcher, fake, images = await run(respond, stamps=(1_000_000_001, 2_000_000_000), count=2)
    assert [stamp_ns(each["header"]["stamp"]) for each in images] == [1_000_000_001, 2_000_000_000]
    matched = matcher.matched
    picture = read_image(images[1]["image"], "32FC1")
    assert picture.shape == (20, 30)
    assert (images[1]["f"], images[1]["T" if "T" in images[1] else "t"]) == (30, 0.1)
    # bytes round the likelihoods, and two disparities may be equally probable
    assert (picture == matched.exact.argmax(axis=0)).mean() > 0.95
    assert (matched.truth[~PAIR.occluded] == PAIR.disparity.astype(np.float32)[~PAIR.occluded]).all()
    # 600 pixels are four tiles, the last with 40 pixels too many, of 500 cycles each
    assert len(fake.ops("publish", topic=TILE_TOPIC)) == 8
    assert matched.cycles == 2000
    matcher.finish(tmp_path)
    heading, first, second, times, wrote = capsys.readouterr().out.splitlines()
    assert heading.split()[0] == "pair"
    assert [line.split()[0] for line in (first, second)] == ["1", "2"]
    assert "30 x 20 pixels" in times
    assert wrote == f"wrote {tmp_path / 'disparity.png'}"
    assert imread(tmp_path / "disparity.png").shape[1] == 800


async def test_tiles_that_are_lost_or_answered_twice_change_nothing(monkeypatch):
    monkeypatch.setattr(matcher_module, "_REPEAT_S", 0.05)
    seen = {}

    async def respond(fake, number, tile):
        stamp = stamp_ns(tile["header"]["stamp"])
        seen[stamp] = seen.get(stamp, 0) + 1
        if seen[stamp] > 1:  # each is lost once, then answered twice
            await answer(fake, tile, exact(tile))
            await answer(fake, tile, np.roll(exact(tile), 1, axis=1))

    matcher, _, images = await run(respond, pixels=100)
    assert len(seen) == 6
    assert matcher.matched.cycles == 6 * 500
    assert (matcher.matched.posterior.argmax(axis=0) == read_image(images[0]["image"], "32FC1")).all()
    assert (matcher.matched.disparity == matcher.matched.exact.argmax(axis=0)).mean() > 0.95


async def test_a_tile_or_pixel_without_a_posterior_is_unknown():
    async def respond(fake, number, tile):
        posterior = exact(tile)
        posterior[7] = 0
        await answer(fake, tile, None if number == 1 else posterior)

    _, _, images = await run(respond, pixels=150)
    pixels = read_image(images[0]["image"], "32FC1").ravel()
    assert (pixels[150:300] == UNKNOWN).all()
    assert set(np.flatnonzero(pixels == UNKNOWN)) == {7, *range(150, 300), 307, 457}


async def test_a_stack_of_another_size_is_named():
    async def respond(fake, number, tile):
        await answer(fake, tile, exact(tile)[:100])

    with pytest.raises(BadResultError, match="100 x 16 values came, expected 160 pixels x 16 disparities"):
        await run(respond)


async def test_a_stack_that_does_not_answer_is_given_up(monkeypatch):
    monkeypatch.setattr(matcher_module, "_REPEAT_S", 0.05)

    async def respond(fake, number, tile):
        pass

    with pytest.raises(NoResultError, match="is the master running"):
        await run(respond, first_limit_s=0.5)


async def test_unusable_images_and_a_silent_camera_are_reported_once(monkeypatch, capsys):
    monkeypatch.setattr(matcher_module, "_SILENT_S", 0.02)
    matcher = Matcher(disparities=16, pixels=160, clock=1e8)

    def take(side, image, **changed):
        message = image_message(image, header(9, "camera", 2), "mono8") | changed
        matcher.take_image(side, SimpleNamespace(topic=(LEFT_TOPIC, RIGHT_TOPIC)[side], msg=message))

    for _ in range(2):
        take(0, PAIR.left, header={})
        take(0, PAIR.left)
        take(1, PAIR.right[:10])
    take(0, PAIR.left)
    with pytest.raises(NoResultError, match=f"no pair of images within 0.2 s: .*none on {RIGHT_TOPIC}"):
        await matcher.next_pair(0.2)
    err = capsys.readouterr().err
    assert err.count("no stamp") == err.count("the right one 30 x 10") == err.count("none on") == 1
    take(1, PAIR.right)
    assert (await matcher.next_pair(PATIENCE)).stamp_ns == 9


def test_shares_count_only_pixels_with_a_known_truth():
    truth = np.array([[3.0, np.nan, 5.0, 5.0]])
    assert bad_share(np.array([[3.9, 0.0, 6.5, UNKNOWN]]), truth) == pytest.approx(2 / 3)
    assert bad_share(np.zeros((1, 1)), np.full((1, 1), np.nan)) == 0


def test_a_line_without_a_truth_says_so():
    posterior = np.full((4, 1, 2), 0.25)
    times = {"host_s": 0.03, "total_s": 0.5, "boards_s": 0.02, "cycles": 2_000_000}
    matched = Matched(
        left=np.zeros((1, 2), np.uint8), truth=None, exact=posterior, posterior=posterior, **times
    )
    assert matched.line(3).split() == ["3", "30.0", "2.00", "20.0", "2000000", "-", "-", "100.0%", "0.000"]
