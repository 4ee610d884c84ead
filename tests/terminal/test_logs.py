"""Lines on standard error: text or JSON, and no control characters of anybody else in them."""

import asyncio
import json
import os
import re
import subprocess
import sys
import time
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest
import websockets

from terminal.logs import LogFormat, log_format
from terminal.one_line import one_line, shown
from terminal.output import print_json_line, say, say_if_slow, say_lines, show_progress
from tests.patience import PROCESS_PATIENCE

HOSTILE = "a\nerror: all is well\r\x1b[2J\x9b31m\x07\x08\x7f\u202eend\ud800"
HARMLESS = "a\\nerror: all is well\\r\\x1b[2J\\x9b31m\\x07\\x08\\x7f\\u202eend\\ud800"


def test_what_is_not_printable_is_seen():
    assert one_line(HOSTILE) == HARMLESS
    assert one_line("an ordinary line: 3 °C, Ω, 日本") == "an ordinary line: 3 °C, Ω, 日本"


def test_a_value_is_quoted_if_it_could_be_overlooked_and_cut_if_it_is_long():
    seen = {"": "''", "a ": "'a '", "a b": "a b", "\x1b": r"'\x1b'", 7: "7", "x" * 1000: "x" * 80 + "..."}
    assert {value: shown(value) for value in seen} == seen


def test_a_message_is_one_line(capsys):
    say(HOSTILE)
    assert capsys.readouterr().err == HARMLESS + "\n"
    say_lines("one\n\x1btwo")
    assert capsys.readouterr().err == "one\n\\x1btwo\n"


CODE = f"""
import logging
from terminal.logs import get_logger, log_libraries, name_process
from terminal.output import relay, say, say_error, say_lines, warn
name_process("board3")
log_libraries(logging.WARNING, "hub: %(message)s")
log = get_logger("master", "info")
log.debug("nobody sees this")
log.warning({HOSTILE!r}, frame=7, why={HOSTILE!r}, _reason="failed")
say("hub: listening")
warn("it is late", name="hub")
say_error("no robot")
say_lines("Traceback\\n  line")
relay("a library complains \\x1b", "pcie-app")
relay('{{"time": "2026-01-01T00:00:00", "level": "info", "process": "x", "message": "of a child"}}', "pcie-app")
try:
    raise ValueError("one\\n\\x1btwo")
except ValueError:
    logging.getLogger("bridge").exception("a topic: %s", {HOSTILE!r})
"""


def lines(form, **more):
    environment = {
        key: value for key, value in os.environ.items() if key not in {"BM_LOG_FORMAT", "ROSBAYES_PARENT"}
    }
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
        check=True,
        env=environment | {"BM_LOG_FORMAT": form} | more,
    )
    assert all(line.isprintable() for line in done.stderr.splitlines())
    return done.stderr.splitlines()


@pytest.mark.process
def test_json_is_one_object_per_line():
    found = [json.loads(line) for line in lines("json")]
    assert [(each["process"], each["level"], each["message"]) for each in found] == [
        ("master", "warning", HOSTILE),
        ("board3", "info", "hub: listening"),
        ("board3", "warning", "it is late"),
        ("board3", "error", "no robot"),
        ("board3", "info", "Traceback\n  line"),
        ("pcie-app", "info", "a library complains \x1b"),
        ("x", "info", "of a child"),
        ("board3", "error", f"a topic: {HOSTILE}"),
    ]
    assert (found[0]["frame"], found[0]["why"], found[0]["reason"]) == (7, HOSTILE, "failed")
    assert re.match(r"\d{4}-\d\d-\d\dT.*Z", found[0]["time"])
    assert found[-1]["logger"] == "bridge"
    assert "ValueError" in found[-1]["traceback"]


@pytest.mark.thorough
def test_text_is_a_line_for_a_person():
    first, *rest = lines("")
    time, level, _ = first.split(" ", 2)
    assert re.match(r"\d{4}-\d\d-\d\dT.*Z", time)
    assert level == "[warning]"
    assert HARMLESS in first
    assert re.search(r"process=master frame=7 why=", first)
    assert rest[:5] == [
        "hub: listening",
        "hub: warning: it is late",
        "error: no robot",
        "Traceback",
        "  line",
    ]
    assert rest[5] == "a library complains \\x1b"
    assert f"hub: a topic: {HARMLESS}" in rest
    assert rest[-2:] == ["ValueError: one", "\\x1btwo"]


@pytest.mark.parametrize("value", ["", "xml"])
def test_another_format_is_text(monkeypatch, value):
    monkeypatch.setenv("BM_LOG_FORMAT", value)
    assert log_format() is LogFormat.TEXT


def test_progress_is_one_line_that_the_next_line_replaces(capsys, monkeypatch):
    monkeypatch.delenv("BM_LOG_FORMAT", raising=False)
    show_progress("1 result\n")
    show_progress("2 results")
    say("a warning")
    say("another")
    assert capsys.readouterr().err == "1 result\\n\r\x1b[K2 results\r\x1b[Ka warning\nanother\n"
    monkeypatch.setenv("COLUMNS", "20")
    show_progress("x" * 20)  # a line that wraps could not be replaced
    say("end")
    assert capsys.readouterr().err.startswith("x" * 19 + "\r")
    monkeypatch.setenv("BM_LOG_FORMAT", "json")
    show_progress("3 results")
    assert json.loads(capsys.readouterr().err)["message"] == "3 results"


def test_only_a_long_wait_is_reported(capsys, monkeypatch):
    monkeypatch.delenv("BM_LOG_FORMAT", raising=False)
    said = ""
    with say_if_slow("waiting", after_s=0.0):
        while not said.endswith("\n"):
            time.sleep(0.01)
            said += capsys.readouterr().err
    with say_if_slow("waiting", after_s=3600.0):
        pass
    assert (said, capsys.readouterr().err) == ("waiting\n", "")


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
