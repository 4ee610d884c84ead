"""Pipe mode: the lines that pcie-app and publisher read, and the limit of a line."""

import asyncio
import json
import os
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from machines.bm1_kind import BM1
from machines.kind import BoardResult
from pcie_shim.host.mini_cluster import FrameOutput
from services.boards.frames import decode_boards
from services.commands import master, publisher, subscriber
from services.errors import InputLineError
from services.pipes import lines, pcie_app
from services.pipes.pcie_app import reading_from_line
from services.pipes.publisher import result_from_line
from tests.command_runner import invoke
from tests.toolchain.running import build_model
from toolchain.deployment import BM1Section, load_deployment
from toolchain.deployment.filter import Transition
from toolchain.models.model import Known, Model, dimension

BOAT = Path(__file__).parents[3] / "casestudies" / "boat"


def test_a_reading():
    line = b'{"addresses": [1, null, [1, -1]], "stamp_ns": 5, "values": [7.5, null, "hall"], "prior_codes": [9, 2], "more": "ignored"}'
    reading = reading_from_line(line, 1)
    assert (reading.addresses, reading.stamp_ns, reading.prior_codes) == ([1, None, [1, -1]], 5, [9, 2])
    assert reading.values == [7.5, None, "hall"]


@pytest.mark.parametrize(
    "line",
    [
        *(b"3", b"x", b"{}", b"[" * 10**5),
        *(b'{"addresses": [71.9]}', b'{"addresses": [true]}', b'{"addresses": ["1"]}'),
    ],
)
def test_a_line_that_is_not_a_reading_is_refused(line):
    with pytest.raises(InputLineError, match="line 7 of standard input"):
        reading_from_line(line, 7)


def test_a_result_and_an_array():
    counted = result_from_line(
        b'{"number": 1, "stamp_ns": 5, "addresses": [3, null], "values": [7.5, null],'
        b' "boards": [{"counts": [1, 258], "cycles": 5, "reason": 1}]}',
        1,
        of(2),
    )
    (one,) = decode_boards(counted.result)
    assert (one.words, one.cycles, counted.stamp_ns) == (b"\1\0\0\0\2\1\0\0", 5, 5)
    assert (counted.addresses, counted.values) == ([3, None], [7.5, None])
    assert result_from_line(b"[0.25, 0.75]", 1, of(2)) == [0.25, 0.75]
    counted = result_from_line(board([1, 2, 3, 4], **OF_REPLICAS).encode(), 1, of(2, 2))
    results = decode_boards(counted.result)
    assert results[0].replica_cycles == (9, 5)
    assert BM1.infer(results).posterior == pytest.approx([1 / 3, 2 / 3, 3 / 7, 4 / 7])


def of(lines, replicas=1):
    return BM1Section(lines=lines, replicas=replicas)


def board(counts, reason=1, **more):
    return json.dumps({"number": 1, "boards": [{"counts": counts, "cycles": 5, "reason": reason} | more]})


UNEVEN = {"cycles": 5, "reason": 1, "replica_cycles": [1] * 3, "replica_reasons": [1] * 3}
OF_REPLICAS = {"cycles": 9, "replica_cycles": [9, 5], "replica_reasons": [1, 3]}


@pytest.mark.parametrize(
    ("line", "results", "replicas"),
    [
        *((line, 2, 1) for line in ("[1, -1]", "[1e999, 1]", "[1]", board([1]))),
        *((board(counts), 2, 1) for counts in ([1, True], [1, 4294967296], [-1, 1])),
        (board([1, 2], reason=9), 2, 1),
        *((board([1, 2], cycles=cycles), 2, 1) for cycles in (-1, 2**63, 2**64)),
        (board([1, 2]).replace('"number": 1', f'"number": {2**64}'), 2, 1),
        (board([1, 2, 3, 4], **OF_REPLICAS), 4, 1),
        *(
            (board([1, 2, 3, 4], **OF_REPLICAS | changed), 4, 2)
            for changed in (
                {"replica_cycles": [1]},
                {"replica_reasons": [1, 9]},
                {"replica_cycles": [1, -1]},
                {"replica_reasons": [1]},
            )
        ),
        (json.dumps({"number": 1, "boards": [UNEVEN | {"counts": [1] * count} for count in (2, 4)]}), 6, 3),
    ],
)
def test_a_line_that_is_not_a_result_is_refused(line, results, replicas):
    with pytest.raises(InputLineError, match="line 3 of standard input"):
        result_from_line(line.encode(), 3, of(results // replicas, replicas))


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        (subscriber, ("--topic", "/t")),
        (subscriber, ("--variables", "A")),
        (publisher, ("--topic", "/t")),
        (publisher, ("--field", "data")),
        (master, ("--once", "--connect", "/nowhere")),
    ],
)
def test_flags_without_a_meaning_are_refused_at_once(built, command, flags):
    ended = invoke(command.app, [*flags, "-d", built])
    assert ended.exit_code == 2
    assert ended.stderr.startswith(f"error: {' '.join(flags[-2:])} ")
    assert ended.stderr.count("\n") == 1


async def test_a_line_has_a_limit_however_it_arrives(monkeypatch, tmp_path):
    monkeypatch.setattr(lines, "LINE_LIMIT", 10)
    loop = asyncio.get_running_loop()
    connect, transports = loop.connect_read_pipe, []

    async def connected(*arguments):
        transport, protocol = await connect(*arguments)
        transports.append(transport)
        return transport, protocol

    monkeypatch.setattr(loop, "connect_read_pipe", connected)
    (tmp_path / "lines").write_bytes(b"[1]\n\n[2]\n" + b" " * 20)
    read, write = os.pipe()
    os.write(write, (tmp_path / "lines").read_bytes())
    os.close(write)
    for source in (os.fdopen(read), (tmp_path / "lines").open()):
        with source:
            monkeypatch.setattr(sys, "stdin", source)
            arriving = lines.lines()
            assert [await anext(arriving), await anext(arriving)] == [(1, b"[1]\n"), (3, b"[2]\n")]
            with pytest.raises(InputLineError, match="line 4"):
                await anext(arriving)
            while transports:
                transports.pop().close()
                await asyncio.sleep(0)


def test_pcie_app_filters_its_lines(tmp_path, monkeypatch, capsys):
    moves = np.array([[0.5, 0.5], [0.25, 0.75]])
    known = (Known(name="heard", table=np.full((2, 2), 0.5)),)
    transition = Transition(np.array([1.0, 0]), moves)
    build_model(
        Model(name="m", searched=(dimension("s", size=2),), known=known, transition=transition), tmp_path
    )
    boards, priors = Mock(deployment=load_deployment(tmp_path), open=lambda: "open"), []

    def run(frame):
        priors.append(np.frombuffer(frame.prior_codes, "<u2").tolist())
        words = np.array([0, 5 if frame.number == 1 else 0], "<u4").tobytes()
        times = dict.fromkeys(("register_writes_ns", "compute_ns", "reads_ns", "boards_compute_ns"), 0)
        return FrameOutput(
            boards=(BoardResult(words, 9, 1),), slices=1, link_bytes=0, link_transfers=0, **times
        )

    boards.run = run
    monkeypatch.setattr(pcie_app, "blocking_lines", lambda: [(at, b'{"addresses": [0]}') for at in (1, 2, 3)])
    assert pcie_app.compute_lines(boards, 16) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3
    last = np.array([0.25, 0.75]) @ moves  # the second line has no posterior, so it is predicted twice
    assert priors == [
        [65535, 65535],
        [int(65536 / 3 + 0.5), 65535],
        [int(65536 * last[0] / last[1] + 0.5), 65535],
    ]
