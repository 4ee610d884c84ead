"""Any text in a sentence is printed as one line without control characters."""

import asyncio
import json
import subprocess
import sys
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest
import websockets

from terminal.one_line import one_line, shown
from terminal.output import print_json_line, say, say_lines
from tests.patience import PROCESS_PATIENCE

HOSTILE = "a\nerror: all is well\r\x1b[2J\x9b31m\x07\x08\x7f\u202eend\ud800"
HARMLESS = "a\\nerror: all is well\\r\\x1b[2J\\x9b31m\\x07\\x08\\x7f\\u202eend\\ud800"


def test_what_is_not_printable_is_seen():
    assert one_line(HOSTILE) == HARMLESS
    assert one_line("an ordinary line: 3 °C, Ω, 日本") == "an ordinary line: 3 °C, Ω, 日本"


@pytest.mark.parametrize(
    ("value", "seen"),
    [
        ("", "''"),
        (" ", "' '"),
        ("a ", "'a '"),
        ("a b", "a b"),
        ("\x1b", r"'\x1b'"),
        (7, "7"),
        ("x" * 1000, "x" * 80 + "..."),
    ],
)
def test_a_value_is_seen(value, seen):
    assert shown(value) == seen


def test_a_message_is_one_line(capsys):
    say(HOSTILE)
    assert capsys.readouterr().err == HARMLESS + "\n"
    say_lines("one\n\x1btwo")
    assert capsys.readouterr().err == "one\n\\x1btwo\n"


@pytest.mark.thorough
def test_what_is_logged_is_a_line():
    code = f"""
import logging
from terminal.logs import get_logger, log_libraries
log_libraries(logging.WARNING, "hub: %(message)s")
get_logger("master").warning({HOSTILE!r}, reason={HOSTILE!r}, frame=7)
logging.getLogger("bridge").warning("a topic: %s", {HOSTILE!r})
try:
    raise ValueError("one\\n\\x1btwo")
except ValueError:
    logging.getLogger("bridge").exception("failed")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PROCESS_PATIENCE, check=True
    )
    ours, theirs, *trace = done.stderr.splitlines()
    assert f"warning: frame=7 {HARMLESS} reason=" in ours
    assert theirs == f"hub: a topic: {HARMLESS}"
    assert trace[-2:] == ["ValueError: one", "\\x1btwo"]
    assert all(line.isprintable() for line in done.stderr.splitlines())


LINES = """
from terminal.logs import get_logger
log = get_logger("pcie-app", {level!r})
log.debug("computed", frame=17, cycles=512)
log.debug("computed", frame=170, cycles=512)
log.info("4 boards programmed")
log.warning("board 2 is gone", frame=17, why='closed "now"')
"""


@pytest.mark.parametrize(("level", "count"), [("debug", 4), ("info", 2), ("warning", 1)])
@pytest.mark.thorough
def test_a_frame_is_found_by_its_number_and_nothing_is_logged_below_the_level(level, count):
    command = [sys.executable, "-c", LINES.format(level=level)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PROCESS_PATIENCE)
    lines = [line.split(" ", 1)[1] for line in done.stderr.splitlines()]
    assert (
        lines
        == [
            "pcie-app: debug: frame=17 computed cycles=512",
            "pcie-app: debug: frame=170 computed cycles=512",
            "pcie-app: 4 boards programmed",
            r'pcie-app: warning: frame=17 board 2 is gone why="closed \"now\""',
        ][-count:]
    )


@pytest.mark.parametrize("variables", [("--variables", "K"), ()], ids=["without the variable", "all of it"])
@pytest.mark.thorough
async def test_a_server_writes_nothing_over_the_terminal(variables):
    said = HOSTILE.removesuffix("\ud800")
    status = {"op": "status", "level": "error", "msg": said, "id": said}
    message = {"op": "publish", "topic": "/t", "msg": {said: 1, "deep": {said: said}}}

    async def answer(connection):
        async for text in connection:
            if json.loads(text)["op"] == "subscribe":
                for each in (json.dumps(status), said, json.dumps(message)):
                    await connection.send(each)

    async with websockets.serve(answer, "127.0.0.1", 0) as server:
        uri = f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        command = ("--uri", uri, "--topic", "/t", "--type", "a/B", "--count", "1", *variables)
        process = await asyncio.create_subprocess_exec(
            Path(sys.executable).with_name("subscriber"), *command, stdout=PIPE, stderr=PIPE
        )
        out, err = (each.decode().splitlines() for each in await process.communicate())
    assert all(line.isprintable() for line in (*out, *err))
    assert any(HARMLESS.removesuffix("\\ud800") in line for line in err)
    assert not any(line.startswith("error: all is well") for line in err)
    if variables:
        assert (process.returncode, out) == (4, [])
        assert err[-1].startswith("error: ")
    else:
        assert process.returncode == 0
        assert json.loads(out[0]) == message["msg"]


def test_what_is_printed_for_programs_is_what_it_was(capsysbinary):
    told = {"a\x9b31m": "\u202e\U000e0001\n°"}
    print_json_line(told)
    line = capsysbinary.readouterr().out.decode()
    assert line.removesuffix("\n").isprintable()
    assert json.loads(line) == told
