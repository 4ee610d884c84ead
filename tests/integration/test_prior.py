"""Priors end to end: selected by a variable of the message, or written with every frame (thesis 2.1.2).

message ──▶ subscriber ──▶ master ──▶ pcie-app ──▶ PRIOR_SELECT or PRIOR_CODES of two boards ──▶ posterior on the wire
"""

import textwrap

import numpy as np
import pytest

from tests.integration.conftest import Robot, build

PRIORS = np.array([[0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7]])
HEARD = np.array([[0.9, 0.4, 0.4, 0.1], [0.1, 0.6, 0.6, 0.9]])
FINE = ("--prob-bits", "14", "--counter-bits", "16", "--target-count", "20000")


def exact(prior, heard):
    joint = np.asarray(prior) * HEARD[heard]
    return joint / joint.sum()


def built(folder, *, select, options=()):
    """A deployment of four rooms, one thing heard, and a prior that is selected or not."""
    folder.mkdir()
    selection = f"PriorSelect(name='time', table=np.array({PRIORS.tolist()}))" if select else "None"
    (folder / "model.py").write_text(
        textwrap.dedent(f"""
            import numpy as np
            from toolchain.models.model import Known, Model, PriorSelect, dimension

            def model():
                return Model(
                    name="rooms",
                    searched=(dimension("room", size=4),),
                    known=(Known(name="heard", table=np.array({HEARD.tolist()})),),
                    prior_select={selection},
                )
            """)
    )
    return build(folder, folder / "built", "--partitions", "2", *FINE, *options)


async def posteriors(stage, deployment, messages, *flags):
    """What is published for each message in turn."""
    _, uri = await stage.hub()
    master = stage.start("master", "--loop", *flags, "-d", str(deployment), "--uri", uri)
    async with Robot(uri) as robot:
        await master.says("pcie-app: 2 boards")
        await master.says("publisher: publishing")
        await robot.keep_publishing(**messages[0])
        await robot.have(1)
        await robot.stop_publishing()
        return [
            (await robot.answer(await robot.publish(**message)))[1]["data"] for message in messages
        ], master


@pytest.mark.parametrize("flags", [(), ("--fused",)])
async def test_a_variable_selects_the_prior(stage, tmp_path, flags):
    deployment = built(tmp_path / "rooms", select=True)
    messages = [{"heard": heard, "time": time} for heard in (0, 1) for time in (0, 1)]
    found, _ = await posteriors(stage, deployment, messages, *flags)
    for message, posterior in zip(messages, found, strict=True):
        assert posterior == pytest.approx(exact(PRIORS[message["time"]], message["heard"]), abs=0.02)


async def test_a_prior_is_written_with_every_frame(stage, tmp_path):
    deployment = built(
        tmp_path / "rooms", select=False, options=("--prior-mode", "written", "--prior-path", "belief")
    )
    beliefs = [[1, 1, 1, 1], [4, 2, 1, 1], [0, 0, 3, 1]]
    messages = [{"heard": heard, "belief": belief} for belief in beliefs for heard in (0, 1)]
    found, master = await posteriors(stage, deployment, messages)
    for message, posterior in zip(messages, found, strict=True):
        assert posterior == pytest.approx(exact(message["belief"], message["heard"]), abs=0.02)
    assert "unusable" not in master.err
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        await robot.keep_publishing(heard=1, belief=[1, 2, 3])
        master = stage.start("master", "--once", "-d", str(deployment), "--uri", uri)
        assert await master.end() == 4
