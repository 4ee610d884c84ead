"""The sprinkler: its network, its garden, and the viewer's estimates from messages made by hand.

garden -> /sprinkler/grass;  fake stack -> /bm/frame, /bm/samples, /BMresults -> viewer
"""

import asyncio
import base64
import itertools
import math

import numpy as np
import pytest
from matplotlib.image import imread

from casestudies.sprinkler.garden import mornings, publish_mornings
from casestudies.sprinkler.model import exact_rain, model
from casestudies.sprinkler.viewer import FrameSummary, SamplesViewer, draw, frame_of, mean_and_error
from posteriors.errors import NoResultError
from posteriors.frame_report import FrameReport
from posteriors.posterior import Posterior
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE
from tests.posteriors.messages import posterior_message, report_message

DRY, WET = 0, 1


def test_the_network_is_that_of_the_thesis():
    network = model().network()
    assert network.names == ("R", "S", "G")
    assert [each.scope for each in network.factors] == [("R",), ("R", "S"), ("R", "S", "G")]
    assert ([each.label for each in network.searched], network.known) == (["R"], ("G",))
    assert [variable.path for variable in network.variables] == ["data"]
    together = np.einsum("r,rs,rsg->rsg", *(each.table for each in network.factors))
    assert together[1].sum(axis=0)[WET] == pytest.approx(0.16038)
    assert together.sum(axis=(0, 1))[WET] == pytest.approx(0.44838)
    assert exact_rain(WET) == pytest.approx(0.3577, abs=5e-5)
    assert exact_rain(DRY) == pytest.approx(0.03962 / 0.55162)


def test_the_mornings_of_a_garden_are_drawn_from_the_model():
    drawn = np.array(list(itertools.islice(mornings(3), 20_000)))
    same, other = (list(itertools.islice(mornings(seed), 50)) for seed in (3, 4))
    assert same == [tuple(each) for each in drawn[:50]]
    assert other != same
    joint = np.einsum("r,rs,rsg->rsg", *(each.table for each in model().network().factors))
    for state in itertools.product((0, 1), repeat=3):
        share = (drawn == state).all(axis=1).mean()
        assert abs(share - joint[state]) <= 5 * math.sqrt(joint[state] / len(drawn))


async def test_the_grass_of_each_morning_is_published():
    async with FakeRosbridge() as fake:
        await publish_mornings(fake.uri, seed=5, rate=1000, count=20)
        await fake.wait_for_op("publish", topic="/sprinkler/grass", count=20)
        published = fake.ops("publish")
    expected = [("/sprinkler/grass", wet) for *_, wet in itertools.islice(mornings(5), 20)]
    assert [(op["topic"], op["msg"]["data"]) for op in published] == expected


def posterior_of(samples, effective, number=1):
    rain = float((samples[:, 0] & 1).mean())
    details = {"effective_samples": str(effective)}
    if rain:
        details["standard_error"] = f"{math.sqrt(rain * (1 - rain) / effective):.4g}"
    report = FrameReport(stamp_ns=number, outcome="samples", number=number, details=details)
    return Posterior(probabilities=(1 - rain, rain), labels=("R",), sizes=(2,), heard_ns=0, report=report)


def states(rain, grass, count, seed=0):
    """Independent packed states, uint8[count, 4]."""
    found = np.zeros((count, 4), np.uint8)
    found[:, 0] = (np.random.default_rng(seed).random(count) < rain) | (4 * grass)
    return found


def values(packed):
    """The values of R, S and G."""
    return np.stack([packed[:, 0] >> bit & 1 for bit in range(3)], axis=1).astype(np.int64)


def test_a_frame_is_its_samples_in_summary():
    samples = states(0.3, WET, 1000)
    frame = frame_of(posterior_of(samples, 400, number=7), values(samples))
    assert (frame.number, frame.grass, frame.effective) == (7, WET, 400)
    assert frame.curve[0].tolist() == [1, samples[0, 0] & 1]
    for count, rained in frame.curve:
        assert rained == (samples[:count, 0] & 1).sum()
    assert frame.curve[-1, 0] == 1000
    assert frame.curve[-1, 1] / 1000 == frame.share
    assert frame.error == pytest.approx(math.sqrt(0.3 * 0.7 / 400), rel=0.1)
    still = frame_of(posterior_of(states(0, DRY, 100), 2), values(states(0, DRY, 100)))
    assert (still.grass, still.share, still.error) == (DRY, 0, 0.5)


def test_the_stated_error_of_the_mean_is_that_of_independent_frames():
    frames = []
    for seed in range(100):
        samples = states(0.36, WET, 500, seed)
        frames.append(frame_of(posterior_of(samples, 500), values(samples)))
    mean, error = mean_and_error(frames)
    assert error == pytest.approx(math.sqrt(0.36 * 0.64 / 50_000), rel=0.05)
    assert abs(mean - 0.36) < 4 * error


def test_the_picture_shows_the_estimates_at_their_heights(tmp_path):
    path = tmp_path / "new" / "sprinkler.png"

    def height(share):
        """The mean row of the pixels of wet grass: curve, marks, and what does not depend on the share."""
        curve = np.array([[n, share * n] for n in (10, 100, 1000)])
        frames = [
            FrameSummary(number=n, grass=WET, share=share, error=0.1, effective=50, curve=curve)
            for n in (1, 2)
        ]
        draw(
            path,
            [*frames, FrameSummary(number=3, grass=DRY, share=0.1, error=0.1, effective=50, curve=curve)],
        )
        picture = imread(path)[..., :3]
        assert picture.shape[1] > 800
        blue = np.abs(picture - (0x44 / 255, 0x77 / 255, 0xAA / 255)).max(axis=2) < 0.02
        assert blue.sum() > 500
        return np.argwhere(blue)[:, 0].mean()

    assert height(0.2) - height(0.8) > 50


class FakeStack:
    """Publishes frames as a master does, on a fake server."""

    def __init__(self, fake):
        self.fake = fake
        self.number = 0

    async def frame(self, samples, *, sent=("frame", "samples", "result")):
        self.number += 1
        rain = float((samples[:, 0] & 1).mean())
        stamp = {"sec": self.number, "nanosec": 0}
        values = {"number": self.number, "published": "true", "effective_samples": "50.0", "sent_ns": 1}
        dims = [{"label": "sample", "size": len(samples), "stride": samples.size}]
        dims.append({"label": "byte", "size": samples.shape[1], "stride": samples.shape[1]})
        data = base64.b64encode(samples.tobytes()).decode()
        result = posterior_message([1 - rain, rain], 2)
        result["layout"]["dim"][0]["label"] = "R"
        messages = {
            "frame": ("/bm/frame", report_message(stamp, "samples", **values)),
            "samples": ("/bm/samples", {"layout": {"dim": dims, "data_offset": 0}, "data": data}),
            "result": ("/BMresults", result),
        }
        for each in sent:
            await self.fake.publish(*messages[each])


@pytest.fixture
async def watched(tmp_path, monkeypatch):
    """A function that runs a viewer of some results on a fake server, on which `publish(stack)` publishes."""
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))

    async def watch(count, publish, limit_s=PATIENCE):
        viewer = SamplesViewer(count)
        async with FakeRosbridge() as fake:
            watching = asyncio.create_task(viewer.watch(fake.uri, first_limit_s=PATIENCE, limit_s=limit_s))
            for topic in ("/bm/frame", "/bm/samples", "/BMresults"):
                await fake.wait_for_op("subscribe", topic=topic)
            try:
                await publish(FakeStack(fake))
                await asyncio.wait_for(watching, PATIENCE)
            finally:
                watching.cancel()
        return viewer

    return watch


async def test_the_viewer_pairs_samples_with_results_in_any_order(watched, tmp_path, capsys):
    batches = [states(0.36, WET, 500, seed) for seed in range(3)] + [states(0.07, DRY, 500, 9)]

    async def publish(stack):
        await stack.frame(batches[0])
        await stack.frame(batches[1], sent=("samples", "frame", "result"))
        await stack.frame(batches[2], sent=("frame", "samples"))  # its result is lost
        await stack.frame(batches[3], sent=("frame", "result", "samples"))
        await stack.frame(batches[1])  # the bank of seeds has come round
        await stack.frame(batches[2], sent=("frame", "result", "samples"))

    viewer = await watched(5, publish)
    assert [(frame.grass, frame.curve[-1].tolist()) for frame in viewer.frames] == [
        (int(each[0, 0]) >> 2, [500, int((each[:, 0] & 1).sum())])
        for each in (batches[0], batches[1], batches[3], batches[2])
    ]
    assert viewer.results == 5
    viewer.finish(tmp_path / "out")
    assert imread(tmp_path / "out" / "sprinkler.png").shape[1] > 800
    out, warned = capsys.readouterr()
    assert warned.count("left out") == 1
    mean = sum((batches[at][:, 0] & 1).mean() for at in (0, 1, 2)) / 3
    assert f"{mean:.4f} +- {mean_and_error([f for f in viewer.frames if f.grass])[1]:.4f}" in out
    assert "0.3577" in out


async def test_a_frame_whose_samples_are_lost_is_left_out(watched, capsys):
    batches = [states(0.36, WET, 500, seed) for seed in range(6)]

    async def publish(stack):
        await stack.frame(batches[0], sent=("frame", "result"))
        for batch in batches[1:]:
            await stack.frame(batch)

    viewer = await watched(6, publish)
    assert [frame.curve[-1, 1] for frame in viewer.frames] == [
        int((each[:, 0] & 1).sum()) for each in batches[1:]
    ]
    assert capsys.readouterr().err.count("warning: ") == 1


async def test_a_deployment_without_a_stream_is_told(watched):
    with pytest.raises(NoResultError) as told:
        await watched(1, lambda stack: stack.frame(states(0.36, WET, 10), sent=("frame", "result")), 0.1)
    assert "--stream" in str(told.value)
