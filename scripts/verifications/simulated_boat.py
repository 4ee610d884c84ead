"""The boat on simulated hardware: ten frames, whose counts must be those of emulated boards.

deployment of the boat --> boards 0, 1, 2, 3: emulated           --> counts, cycles, reason of each frame,
                       --> boards 0, 2, 3: emulated; 1: the VHDL --> the same?
"""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from pcie_shim import register_map
from pcie_shim.endpoint import parse_endpoint
from pcie_shim.errors import PcieShimError
from pcie_shim.host.frame import FrameInput
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.programming_file import Image, read_image

FRAMES = 10
BOARD = 1
"""The partition that is simulated: 256 lines, in the middle of the map."""

_COMPILING_S = 1200.0
_ENDING_S = 30.0
_ANSWER_S = 120.0
_BIN = Path(sys.executable).parent


class SimulatedBoat:
    """The check, with a simulator of its own for each run."""

    def __init__(self, engine: str, frames: int) -> None:
        self._engine = engine
        self._frames = frames

    @property
    def name(self) -> str:
        """Description of the check, for people."""
        frames = "a frame" if self._frames == 1 else f"{self._frames} frames"
        return f"boat: {frames} with one of four boards in {self._engine}"

    def failure(self) -> str | None:
        """Run the frames on emulated and simulated boards, and return why they differ, or None."""
        with tempfile.TemporaryDirectory(prefix="hdl-boat-") as where:
            folder = Path(where)
            try:
                return self._failure(folder)
            except (PcieShimError, OSError, subprocess.SubprocessError) as error:
                return str(error)

    def _failure(self, folder: Path) -> str | None:
        deployment = folder / "boat"
        source = ("--uri", "ws://localhost:9090", "--topic", "/boat", "--type", "boat_msgs/Sensors")
        root = Path(__file__).parents[2]
        boat = root / "casestudies" / "boat"
        command = [str(_BIN / "toolchain"), "build", str(boat), "-o", str(deployment), "--partitions", "4"]
        subprocess.run([*command, *source], check=True, capture_output=True, timeout=_COMPILING_S)
        images = [read_image(deployment / "boards" / f"board{at}.bm") for at in range(4)]
        frames = _frames(images[BOARD], self._frames)
        endpoints = [f"unix:{folder}/boards/board{at}.sock" for at in range(4)]
        simulated = f"unix:{folder}/simulated.sock"
        engine = ("--engine", self._engine, "--hardware", str(root / "build" / "hardware"))
        hardware = (*engine, "-d", str(deployment), "--index", str(BOARD))
        with (
            _board("--boards", "4", "--directory", str(folder / "boards")),
            _board(*hardware, "--listen", simulated),
        ):
            emulated, emulated_s = _outcomes(endpoints, images, frames)
            speeds = [_speed(endpoints[BOARD])]
            endpoints[BOARD] = simulated
            found, simulated_s = _outcomes(endpoints, images, frames)
            speeds.append(_speed(simulated))
        cycles = sum(frame[BOARD][1] for frame in found)
        print(
            f"     {speeds[1]} cycles/s in {self._engine}, {speeds[0]} emulated, when all lines count; "
            f"{cycles} cycles of {len(frames)} frames in {simulated_s:.2f} s, emulated in {emulated_s:.3f} s",
            flush=True,
        )
        wrong = [at for at, (one, other) in enumerate(zip(found, emulated, strict=True)) if one != other]
        return f"frames {wrong} differ" if wrong else None


def _frames(image: Image, count: int) -> list[FrameInput]:
    """Return frames, each with the most likely readings of a line of this board; in some, one is missing."""
    machine = image.machine
    lines = machine.parameters.lines
    frames = []
    for at in range(count):
        line = (2 * at + 1) * lines // (2 * count)
        readings: list[int | None] = [int(table[:-1, line].argmax()) for table in machine.tables]
        if at % 3 == 2:
            readings[at % len(readings)] = None
        frames.append(
            FrameInput(
                addresses=tuple(readings),
                target_count=255,
                max_cycles=1 << 17,
                bank=at % machine.parameters.rng_banks,
            )
        )
    return frames


@contextlib.contextmanager
def _board(*flags: str) -> Iterator[None]:
    """Run the command `board` until the end of the block, which begins when it listens."""
    process = subprocess.Popen([str(_BIN / "board"), *flags], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        deadline = time.monotonic() + _COMPILING_S
        said = ""
        while "listen" not in said:
            if not select.select([process.stderr], [], [], max(0.0, deadline - time.monotonic()))[0]:
                message = f"board {' '.join(flags)} does not listen"
                raise OSError(message)
            said = process.stderr.readline()
            if not said:
                message = f"board {' '.join(flags)} ended"
                raise OSError(message)
            if "error" in said:
                raise OSError(said.strip())
        yield
    finally:
        process.terminate()
        process.communicate(timeout=_ENDING_S)


def _outcomes(
    endpoints: Sequence[str], images: Sequence[Image], frames: Sequence[FrameInput]
) -> tuple[list[list[tuple[bytes, int, int]]], float]:
    """Return counts, cycles and reason of each board in each frame, and the seconds of all frames."""
    with MiniCluster.open(endpoints, images, timeout=_ANSWER_S, slack=_ANSWER_S) as cluster:
        cluster.run(frames[0])  # the first frame also warms up
        began = time.monotonic()
        outputs = [cluster.run(frame) for frame in frames]
        elapsed = time.monotonic() - began
    found = [
        [(board.words, board.cycles, int(board.reason)) for board in output.boards] for output in outputs
    ]
    return found, elapsed


def _speed(endpoint: str) -> int:
    """Return a board's own measurement of its cycles per second."""
    with SocketLink.open(parse_endpoint(endpoint), timeout=_ANSWER_S) as link:
        return link.read32(register_map.CAP_SPEED)
