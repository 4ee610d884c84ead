"""Time of transfers over the link by their size and the number of boards, for each --link-rate (thesis 2.3, 4.3).

bench ── blocks of 1 to 8,192 words ──▶ INPUTS of 1, 2 or 4 boards, and back
bench ── frames of 4,096 results on 1, 2 or 4 boards, sent with the done message or read ──▶ time without computing

Every measurement includes the time of the socket. The bench measures this time with --link-rate none, and subtracts it
from the other times. Then the bench fits the rate and the latency of each modelled link.
"""

import argparse
import asyncio
import itertools
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from machines.bm1 import BM1Machine
from machines.bm1_kind import BM1
from machines.kind import FrameInput
from machines.parameters import BM1Parameters
from pcie_shim import register_map as rm
from pcie_shim.endpoint import parse_endpoint
from pcie_shim.host.loader import program
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.programming_file import Image, Partition
from pcie_shim.wires import WIRES, LinkRate
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.running.stand import temporary_stand
from terminal.output import write_json
from terminal.pictures import new_figure, save_figure

BOARDS = (1, 2, 4)
WORDS = (1, 16, 256, 1024, 4096, 8192)
RESULTS = 4096
WAYS = {"sent": (), "read": ("--read-results",)}
"""Flags of `board` by the way in which results arrive: in the done message, or by register reads as in the thesis."""
SLOWER = 20
"""Number of measurements of each other link per measurement of JTAG, whose transfers take milliseconds."""
TOLERANCE = 0.15
"""Maximum relative deviation of a fitted rate from the stated one."""
LIMIT_S = 30.0

SIZES = tuple(4 * words for words in WORDS)
"""Sizes of the transferred blocks, in bytes."""

Move = Callable[[Sequence[SocketLink], int], None]
Transfers = dict[tuple[LinkRate, str, int, int], float]
"""The time (us) until a block has moved to or from each board, by link, direction, boards and size."""
Frames = dict[tuple[LinkRate, str, int], float]
"""The time (us) of a frame of RESULTS results without computing, by link, way of the results (WAYS) and boards."""


class Fitted(NamedTuple):
    """The rate and latency of a link, fitted to the time that its transfers take longer than the socket alone."""

    link: LinkRate
    direction: str
    mbps: float
    latency_us: float

    @property
    def is_right(self) -> bool:
        """True if the fitted rate agrees with the emulated wire's rate (`WIRES`) within `TOLERANCE`."""
        return abs(self.mbps / WIRES[self.link].mbps - 1) <= TOLERANCE


def image(lines: int, index: int, count: int, *, replicas: int = 1) -> Image:
    """Return an image whose machine reaches a count of 1 in a few cycles.

    With several replicas, the block INPUTS has as many words as the register map allows.
    """
    parameters = BM1Parameters(lines=lines, sensor_bits=(1,), replicas=replicas)
    codes = np.full((2, lines), parameters.ones_code, np.uint16)
    return Image(
        machine=BM1Machine(parameters, codes[:1], (codes,)),
        partition=Partition(index, count, index * lines, count * lines),
        interface_sensors=rm.INPUTS.words if replicas > 1 else BM1.registers(parameters).input_words,
        interface_results=lines * replicas,
        model_hash="0" * 64,
        build_date="",
        tool_version="",
    )


def write(links: Sequence[SocketLink], words: int) -> None:
    """Write a block to one board after the other, and wait for each acknowledgement."""
    block = bytes(4 * words)
    for link in links:
        link.write_block(rm.INPUTS, block)


def post(links: Sequence[SocketLink], words: int) -> None:
    """Post a block to every board, and then read a word of each; a board answers when the block has arrived."""
    block = bytes(4 * words)
    for link in links:
        link.post([(rm.INPUTS, block)])
    for link in links:
        link.read32(rm.DONE)


def read(links: Sequence[SocketLink], words: int) -> None:
    """Read a block from one board after the other."""
    for link in links:
        link.read_block(rm.INPUTS, words)


MOVES: dict[str, Move] = {"write": write, "post": post, "read": read}


def times(works: Mapping[LinkRate, Callable[[], float]], repeats: int) -> dict[LinkRate, float]:
    """Return the 10th percentile of the times of each function: other processes can only make a measurement longer."""
    found: dict[LinkRate, list[float]] = {link: [] for link in works}
    for turn in range(-SLOWER, repeats):
        for link, work in works.items():
            if link is LinkRate.JTAG and turn % SLOWER:
                continue
            us = work()
            if turn >= 0:  # the others warm up
                found[link].append(us)
    return {link: sorted(each)[len(each) // 10] for link, each in found.items()}


def timed(move: Move, links: Sequence[SocketLink], words: int) -> float:
    """Return how long moving a block of `words` over the links takes, in microseconds."""
    began = time.perf_counter_ns()
    move(links, words)
    return (time.perf_counter_ns() - began) / 1e3


def endpoints(folder: Path, link: LinkRate, boards: int) -> list[str]:
    """Return the endpoints of the boards whose link has this rate."""
    return [f"unix:{folder / link}/board{at}.sock" for at in range(boards)]


def measure_transfers(folder: Path, boards: int, words: int, repeats: int) -> Transfers:
    """Measure blocks of one size, in both directions, over every kind of link."""
    found = {}
    with ExitStack() as stack:
        links: dict[LinkRate, list[SocketLink]] = {link: [] for link in LinkRate}
        for link in LinkRate:
            for place in map(parse_endpoint, endpoints(folder, link, boards)):
                program(place, image(1, 0, 1, replicas=2), timeout=LIMIT_S)
                links[link].append(stack.enter_context(SocketLink.open(place, timeout=LIMIT_S)))
        for direction, move in MOVES.items():
            works = {link: partial(timed, move, those, words) for link, those in links.items()}
            for link, us in times(works, repeats).items():
                found[link, direction, boards, 4 * words] = us
    return found


def measure_frames(folder: Path, way: str, boards: int, repeats: int) -> Frames:
    """Measure frames on this number of boards."""
    parts = [image(RESULTS // boards, index, boards) for index in range(boards)]
    frame = FrameInput(addresses=(0,), target_count=1, max_cycles=1 << 12, bank=0, stop="own")
    with ExitStack() as stack:
        clusters = {
            link: stack.enter_context(
                MiniCluster.open(endpoints(folder, link, boards), parts, timeout=LIMIT_S, reprogram=True)
            )
            for link in LinkRate
        }

        def besides(link: LinkRate) -> float:
            began = time.perf_counter_ns()
            output = clusters[link].run(frame)
            return (time.perf_counter_ns() - began - output.boards_compute_ns) / 1e3

        found = times({link: partial(besides, link) for link in LinkRate}, repeats)
    return {(link, way, boards): us for link, us in found.items()}


def fits(transfers: Transfers) -> list[Fitted]:
    """Fit the rate and latency of a transfer to the times of one board, after subtracting those of the bare socket."""
    found = []
    for link, direction in itertools.product((LinkRate.PCIE_GEN2, LinkRate.JTAG), ("write", "read")):
        those, alone = (
            [transfers[each, direction, 1, size] for size in SIZES] for each in (link, LinkRate.NONE)
        )
        more = np.subtract(those, alone)
        us_a_byte, _ = np.polyfit(SIZES, more, 1)
        # those of a word are two transfers, of 44 bytes with their headers
        # on a busy computer, the larger blocks may have been the faster ones
        rate = 8 / us_a_byte if us_a_byte > 0 else math.nan
        found.append(Fitted(link, direction, rate, (more[0] - 44 * us_a_byte) / 2))
    return found


async def bench(arguments: argparse.Namespace) -> int:
    """Start boards of every kind, measure them, and print the tables."""
    transfers: Transfers = {}
    frames: Frames = {}
    for way, flags in WAYS.items():
        async with temporary_stand() as stand:
            for link in LinkRate:
                own = (
                    "--boards",
                    str(max(BOARDS)),
                    "--directory",
                    str(stand.folder / link),
                    "--link-rate",
                    link,
                )
                await stand.start(f"boards-{link}", "boards listen", "board", *own, *flags)
            for boards in BOARDS:
                for words in WORDS if way == "sent" else ():
                    await asyncio.sleep(0)  # for Ctrl-C
                    transfers |= measure_transfers(stand.folder, boards, words, arguments.repeats)
                frames |= measure_frames(stand.folder, way, boards, arguments.repeats)
    fitted = fits(transfers)
    show(transfers, frames, fitted)
    if arguments.json:
        of_transfer, of_frame = ("link", "direction", "boards", "size", "us"), ("link", "way", "boards", "us")
        parts = {
            "transfers": [dict(zip(of_transfer, (*of, us), strict=True)) for of, us in transfers.items()],
            "frames": [dict(zip(of_frame, (*of, us), strict=True)) for of, us in frames.items()],
            "fitted": [each._asdict() for each in fitted],
        }
        write_json(arguments.json, parts)
    if arguments.picture:
        draw(arguments.picture, transfers, frames)
    return int(arguments.check and not all(each.is_right for each in fitted))


def show(transfers: Transfers, frames: Frames, fitted: Sequence[Fitted]) -> None:
    """Print the tables on standard output."""
    rows: list[list[str] | None] = []
    for boards in BOARDS:
        for direction, size in itertools.product(MOVES, SIZES):
            row = [str(boards), direction, f"{size:,}"]
            for link in LinkRate:
                us = transfers[link, direction, boards, size]
                mbps = 8 * size * boards / us
                row += [f"{us:,.0f}", f"{mbps:,.{int(mbps < 100)}f}"]
            rows.append(row)
        rows.append(None)
    units = (f"{link}\n{unit}" for link in LinkRate for unit in ("us", "Mbps"))
    title = "a block to or from each board: microseconds, and Mbps of payload over all boards"
    print_table(title, ("boards", "", "bytes", *units), rows, left=0)
    rows = []
    for way, boards in itertools.product(WAYS, BOARDS):
        rows.append([way, str(boards), *(f"{frames[link, way, boards]:,.0f}" for link in LinkRate)])
    title = f"a frame of {RESULTS} results: microseconds besides computing"
    print_table(title, ("results", "partitions", *LinkRate), rows, left=0)
    for each in fitted:
        wire = WIRES[each.link]
        verdict = "equal within" if each.is_right else "on a quiet computer, they differ by at most"
        print(
            f"{each.link}, {each.direction}: {each.mbps:,.4g} Mbps and {each.latency_us:,.3g} us a transfer more than the "
            f"socket alone; the model has {wire.mbps:,g} Mbps and {wire.latency_us:g} us; {verdict} {TOLERANCE:.0%}"
        )
    by_link = {each.link: each.mbps for each in fitted if each.direction == "read"}
    slow, fast = (transfers[link, "read", 1, SIZES[-1]] for link in (LinkRate.JTAG, LinkRate.PCIE_GEN2))
    print(
        f"PCIe has {by_link[LinkRate.PCIE_GEN2] / by_link[LinkRate.JTAG]:.0f} times the rate of USB/JTAG (thesis 2.3: "
        f"around 800); with the emulation's socket before it, {SIZES[-1]:,} bytes are read {slow / fast:.0f} times as "
        f"fast; {len(os.sched_getaffinity(0))} cores"
    )


def draw(path: Path, transfers: Transfers, frames: Frames) -> None:
    """Draw the time of a read by its size (dotted: the link model's own time), and of a frame by number of boards."""
    figure = new_figure(9.6, 4.2)
    by_size, by_boards = figure.subplots(1, 2)
    for link, colour in zip(LinkRate, ("#bbbbbb", "#4477aa", "#ee6677"), strict=True):
        those = [transfers[link, "read", 1, size] for size in SIZES]
        by_size.loglog(SIZES, those, marker="o", color=colour, label=link)
        if link in WIRES:
            model = [1e6 * WIRES[link].seconds(size, 2) for size in SIZES]
            by_size.loglog(SIZES, model, linestyle=":", color=colour, label=f"{link}, without the socket")
        own = [frames[link, "read", boards] for boards in BOARDS]
        by_boards.semilogy(BOARDS, own, marker="o", color=colour)
    by_size.set_xlabel("bytes read from one board")
    by_size.set_ylabel("us")
    by_size.legend(frameon=False)
    by_boards.set_xlabel("boards (partitions)")
    by_boards.set_xticks(BOARDS)
    by_boards.set_title(f"a frame of {RESULTS} results that are read, besides computing", fontsize=10)
    by_size.set_title("one block", fontsize=10)
    save_figure(figure, path)


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench link",
        "Measure the link to the boards by size of a transfer and boards, for each --link-rate.",
    )
    parser.flag("--repeats", f"transfers of each size; over JTAG a {SLOWER}th", 400)
    parser.switch("--check", f"exit 1 if a rate differs from the model's by over {TOLERANCE:.0%}")
    parser.flag("--json", "write all numbers to this file", type=Path)
    parser.flag("--picture", "draw them into this PNG", type=Path)
    parser.run(bench, 600)
