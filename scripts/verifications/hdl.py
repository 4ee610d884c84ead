"""Verification of the VHDL: comparison with the emulated board, and proofs (scripts/verify hdl).

Each line shows what is verified, the tools that run it, and the question.

random machines --> GHDL, driven through AXI4-Lite     --> same answers as the emulated board?
the boat        --> GHDL or Verilator, behind the link --> same answers as four emulated boards?
units           --> GHDL                               --> correct at values that no machine reaches?
VHDL            --> Verilog (GHDL) --> yosys           --> properties proved for every input?
"""

import argparse
import asyncio
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final

from hdl.test.mutants import MUTANTS, Mutant, caught_by
from hdl.test.project import HardwareToolError
from hdl.test.verification import formal, sessions, units
from machines.kind import FrameInput
from pcie_shim.errors import PcieShimError
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.programming_file import Image, read_image
from scripts.running.flags import ScriptParser
from scripts.running.script import ROOT
from scripts.running.stand import temporary_stand
from scripts.verifications.checks import Tally
from scripts.verifications.installation import install_programs
from terminal.errors import ProcessError
from toolchain.hardware import Simulator

SESSIONS: Final = 60
"""Number of random machines in the matrix."""
BOARD: Final = 1
"""Index of the board that is simulated, among those of the boat: it has 256 lines in the middle of the map."""
_COMPILING_S: Final = 1200.0
_ANSWER_S: Final = 120.0


# The boat on simulated hardware, whose counts must be those of emulated boards


async def boat_failure(engine: str, count: int) -> str | None:
    """Run frames on emulated boards, and again with one simulated board in place of an emulated one.

    Return an error text if the boat cannot be built or the results differ, or None if the results agree.
    """
    source = ("--uri", "ws://localhost:9090", "--topic", "/boat", "--type", "boat_msgs/Sensors")
    boat = ROOT / "casestudies" / "boat"
    async with temporary_stand() as stand:
        folder, deployment = stand.folder, stand.folder / "boat"
        build = ("build", str(boat), "-o", str(deployment), "--partitions", "4", *source)
        await stand.start("toolchain", "", "toolchain", *build)
        if await stand.wait("toolchain"):
            return f"the boat is not built:\n{stand.tails()}"
        images = [read_image(deployment / "boards" / f"board{at}.bm") for at in range(4)]
        frames = _frames(images[BOARD], count)
        endpoints = [f"unix:{folder}/boards/board{at}.sock" for at in range(4)]
        simulated = f"unix:{folder}/simulated.sock"
        hardware = ("--engine", engine, "--hardware", str(ROOT / "build" / "hardware"))
        await stand.start("boards", "listen", "board", "--boards", "4", "--directory", str(folder / "boards"))
        board = ("board", *hardware, "-d", str(deployment), "--index", str(BOARD), "--listen", simulated)
        await stand.start("simulated-board", "listen", *board, limit=_COMPILING_S)
        emulated = _outcomes(endpoints, images, frames)
        endpoints[BOARD] = simulated
        found = _outcomes(endpoints, images, frames)
    wrong = [at for at, (one, other) in enumerate(zip(found, emulated, strict=True)) if one != other]
    return f"frames {wrong} differ" if wrong else None


def _frames(image: Image, count: int) -> list[FrameInput]:
    """Return frames, each with the most probable readings of a line of this board; in some, one reading is missing."""
    machine = image.machine
    frames = []
    for at in range(count):
        line = (2 * at + 1) * machine.parameters.lines // (2 * count)
        readings: list[int | None] = [int(table[:-1, line].argmax()) for table in machine.tables]
        if at % 3 == 2:
            readings[at % len(readings)] = None
        bank = at % machine.parameters.rng_banks
        frames.append(FrameInput(addresses=tuple(readings), target_count=255, max_cycles=1 << 17, bank=bank))
    return frames


def _outcomes(
    endpoints: Sequence[str], images: Sequence[Image], frames: Sequence[FrameInput]
) -> list[list[tuple[bytes, int, int]]]:
    """Return counts, cycles and reason of each board in each frame."""
    with MiniCluster.open(endpoints, images, timeout=_ANSWER_S, slack=_ANSWER_S) as cluster:
        outputs = [cluster.run(frame) for frame in frames]
    return [[(board.words, board.cycles, int(board.reason)) for board in output.boards] for output in outputs]


# All checks, or all mutants


def mutant_failure(mutant: Mutant) -> str | None:
    """Return why no check finds a mutant, or None."""
    found = caught_by(mutant)
    if found is not None:
        print(f"     {mutant.name}: found by {found[0].name}", flush=True)
    return "not found" if found is None else None


def verify(arguments: argparse.Namespace) -> int:
    """Run the matrix or the mutants; exit 1 if a check fails or a mutant is not found."""
    install_programs(
        {"ghdl": "ghdl"} if arguments.mutants else {each: each for each in Simulator.VERILATOR.tools}
    )
    checks: dict[str, Callable[[], str | None]]
    if arguments.mutants:
        checks = {each.name: partial(mutant_failure, each) for each in MUTANTS}
    else:
        checks = {
            "boat: 10 frames with one of four boards in verilator": lambda: asyncio.run(
                boat_failure("verilator", 10)
            ),
            "boat: a frame with one of four boards in ghdl": lambda: asyncio.run(boat_failure("ghdl", 1)),
            **{each.name: each.failure for each in (*units(), *formal(), *sessions(arguments.sessions))},
        }
    tally = Tally()

    def run(name: str) -> None:
        began = time.monotonic()
        try:
            why = checks[name]()
        except TimeoutError:
            why = "a process was not ready in time"
        except (HardwareToolError, PcieShimError, ProcessError, OSError, ValueError) as error:
            why = str(error)
        tally.report(name, began, why)

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # one per core at a time
        list(pool.map(run, [name for name in checks if arguments.only in name]))
    return tally.end()


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify hdl", __doc__)
    parser.switch("--mutants", "check that mistakes in the VHDL are found, one by one")
    parser.flag("--sessions", "random machines", SESSIONS, type=int, metavar="N")
    parser.flag("--only", "what has this in its name", "")
    parser.run_at_once(verify)
