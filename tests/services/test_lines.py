"""What pcie-app and publisher read from standard input, alone: readings, results, probabilities."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from services.errors import InputLineError
from services.pipeline.inference import Inference
from services.pipes.pcie_app import reading_from_line
from services.pipes.publisher import result_from_line

BIN = Path(sys.executable).parent


def test_a_reading():
    reading = reading_from_line(b'{"addresses": [1, null], "stamp_ns": 5, "more": "of no interest"}', 1)
    assert (reading.addresses, reading.stamp_ns) == ([1, None], 5)


@pytest.mark.parametrize(
    "line",
    [
        b"3",
        b"x",
        b"{}",
        b'{"addresses": [71.9]}',
        b'{"addresses": [true]}',
        b'{"addresses": ["1"]}',
        b"[" * 10**5,
    ],
)
def test_no_reading(line):
    with pytest.raises(InputLineError, match="line 7 of standard input cannot be used .*expected"):
        reading_from_line(line, 7)


def test_a_result_and_an_array():
    counted, stamp = result_from_line(
        b'{"number": 1, "boards": [{"counts": [1, 258], "cycles": 5, "reason": 1}]}', 1, 2
    )
    (board,) = Inference(counted).boards
    assert (board.words, board.cycles, stamp) == (b"\1\0\0\0\2\1\0\0", 5, None)
    assert result_from_line(b"[0.25, 0.75]", 1, 2) == [0.25, 0.75]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"[1, -1]", "cannot be used"),
        (b"[1e999, 1]", "cannot be used"),
        (b"[1]", "has 1 values"),
        (b'{"number": 1, "boards": [{"counts": [1, true], "cycles": 5, "reason": 1}]}', "cannot be used"),
        (
            b'{"number": 1, "boards": [{"counts": [1, 4294967296], "cycles": 5, "reason": 1}]}',
            "cannot be used",
        ),
        (b'{"number": 1, "boards": [{"counts": [1, 2], "cycles": 5, "reason": 9}]}', "cannot be used"),
        (b'{"number": 1, "boards": [{"counts": [1], "cycles": 5, "reason": 1}]}', "has 1 values"),
    ],
)
def test_no_result(line, said):
    with pytest.raises(
        InputLineError, match=f"line 3 of standard input {said}.*expected a result of pcie-app"
    ):
        result_from_line(line, 3, 2)


@pytest.fixture(scope="module")
def deployment(tmp_path_factory):
    where = tmp_path_factory.mktemp("deployment")
    (where / "model.py").write_text(
        "import numpy as np\n"
        "from toolchain.models import Known, Model, dimension\n"
        "def model():\n"
        "    known = tuple(Known(name=name, table=np.full((2, 4), 0.5)) for name in 'ABC')\n"
        "    return Model(name='tiny', searched=(dimension('s', size=4),), known=known)\n"
    )
    target = ("--uri", "ws://127.0.0.1:1", "--topic", "/r", "--type", "std_msgs/Float64")
    command = [BIN / "toolchain", "build", where, "-o", where / "built", *target]
    subprocess.run(command, check=True, capture_output=True, timeout=240)
    return where / "built"


def test_a_line_with_too_few_addresses_is_named(deployment, tmp_path):
    socket = tmp_path / "b.sock"
    board = subprocess.Popen([BIN / "board", "--listen", f"unix:{socket}"], stderr=subprocess.PIPE)
    try:
        assert b"listens" in board.stderr.readline()
        done = subprocess.run(
            [BIN / "pcie-app", "-d", deployment, "--boards", f"unix:{socket}"],
            input='{"addresses": [0, 1, 0]}\n\n{"addresses": [0, 1]}\n',
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
    finally:
        board.kill()
        board.communicate()
    assert done.returncode == 2
    assert done.stdout.count("\n") == 1
    assert done.stderr.splitlines()[-1] == (
        "error: line 3 of standard input: The frame has 2 readings; this machine has 3 sensors"
    )


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["subscriber", "--topic", "/t"], "--topic /t is for use without a deployment; "),
        (["subscriber", "--variables", "A"], "--variables A is for use without a deployment; "),
        (["master", "--once", "--connect", "/nowhere"], "--connect /nowhere is no folder; name the one with"),
    ],
)
def test_flags_that_mean_nothing_are_refused_at_once(deployment, command, said):
    done = subprocess.run(
        [BIN / command[0], *command[1:], "-d", deployment],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {said}")
    assert done.stderr.count("\n") == 1


OF_REPLICAS = {
    "counts": [1, 2, 3, 4],
    "cycles": 9,
    "reason": 1,
    "replica_cycles": [9, 5],
    "replica_reasons": [1, 3],
}


def test_a_result_of_replicas():
    line = json.dumps({"number": 1, "boards": [OF_REPLICAS]}).encode()
    counted, _ = result_from_line(line, 1, 4, 2)
    assert Inference(counted).boards[0].replica_cycles == (9, 5)
    assert Inference(counted).posterior == pytest.approx([1 / 3, 2 / 3, 3 / 7, 4 / 7])


@pytest.mark.parametrize(
    ("changed", "replicas", "said"),
    [
        ({}, 1, "has 2 replicas' cycles on a board; expected a result of 1 replica$"),
        ({"replica_cycles": [1]}, 2, "has 1 replicas' cycles on a board; expected a result of 2 replicas"),
        ({"replica_reasons": [1, 9]}, 2, "cannot be used"),
        ({"replica_cycles": [1, -1]}, 2, "cannot be used"),
        (
            {"replica_cycles": [1, 1, 1], "replica_reasons": [1, 1, 1]},
            3,
            "has 4 counts on a board of 3 replicas",
        ),
    ],
)
def test_no_result_of_replicas(changed, replicas, said):
    line = json.dumps({"number": 1, "boards": [OF_REPLICAS | changed]}).encode()
    with pytest.raises(InputLineError, match=f"line 3 of standard input {said}"):
        result_from_line(line, 3, 4, replicas)


def test_a_reading_may_be_rows():
    reading = reading_from_line(b'{"addresses": [[1, -1], null, 3]}', 1)
    assert reading.addresses == [[1, -1], None, 3]
