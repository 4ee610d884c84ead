"""`master --once` with boards whose hardware is GHDL's: the result is that of emulated boards, to the bit.

robot ──▶ hub ──▶ subscriber ──▶ master ──▶ pcie-app ──▶ board --engine ghdl ──▶ VHDL
"""

import json
import shutil
import textwrap

import pytest

from tests.integration.conftest import Robot, build

MODEL = """
    import numpy as np
    from toolchain.models.model import Known, Model, dimension

    def model():
        random = np.random.default_rng(4)
        tables = [random.dirichlet(np.full(6, 0.7), 8).T for _ in range(2)]
        known = (Known(name="D1", table=tables[0]), Known(name="D2", table=tables[1]))
        return Model(name="small", searched=(dimension("place", size=8),), known=known)
"""


def facts(status):
    """Return the parts of a report that concern the machines, without times and without the link."""
    return {
        # a reading ends with its age
        pair["key"]: pair["value"].rpartition(";")[0] if pair["key"].startswith("reading.") else pair["value"]
        for pair in status["values"]
        if not pair["key"].endswith(("_ns", "_us")) and not pair["key"].startswith("link_")
    }


@pytest.mark.thorough
@pytest.mark.skipif(
    shutil.which("ghdl") is None, reason="ghdl is not installed (Debian: apt-get install ghdl)"
)
async def test_once_is_the_same_on_simulated_hardware(stage, tmp_path):
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "model.py").write_text(textwrap.dedent(MODEL))
    deployment = build(tmp_path / "small", tmp_path / "built")
    _, uri = await stage.hub()
    boards = stage.where / "b"
    engine = ("--engine", "ghdl", "--hardware", str(tmp_path / "hardware"))
    hardware = stage.start("board", *engine, "-d", str(deployment), "--directory", str(boards))
    await hardware.says("board 0 listens")
    found = []
    async with Robot(uri) as robot:
        await robot.keep_publishing(D1=2, D2=5)
        for where in (["--boards", f"unix:{boards}/"], []):
            master = stage.start("master", "--once", *where, "-d", str(deployment), "--uri", uri, "--json")
            assert await master.end() == 0, master.err
            found.append(json.loads(master.out))
            await robot.have(len(found))
    assert robot.results[0]["data"] == robot.results[1]["data"]
    simulated, emulated = ([facts(status) for status in report["status"]] for report, _ in robot.paired)
    assert simulated == emulated
    assert int(simulated[0]["cycles"]) > 0
    assert found[0]["seen"] is found[1]["seen"] is True
