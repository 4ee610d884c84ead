"""Lines on standard error in each format: text, dated text, and one JSON object per line."""

import json
import os
import re
import subprocess
import sys
import time

import pytest

from terminal.log_line import LogFormat, log_format
from terminal.output import say, say_if_slow, show_progress
from tests.patience import PROCESS_PATIENCE

CODE = """
import logging
from terminal.log_line import name_process
from terminal.logs import get_logger
from terminal.output import relay, say, say_lines
name_process("board3")
log = get_logger("master", "debug")
log.warning("board 2 is gone\\n", frame=17, cycles=3, _reason="failed")
say("hub: listening")
say("hub: warning: it is late")
say("error: no robot")
say_lines("Traceback\\n  line")
relay("a library complains", "pcie-app")
relay('{"time": "2026-01-01T00:00:00", "level": "info", "process": "x", "message": "of a child"}', "pcie-app")
relay("2026-01-01T00:00:00.000000+00:00 of a child", "pcie-app")
logging.getLogger("websockets").error("odd %s", "\\x1b")
"""


STAMP = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}[+-]\d\d:\d\d "


def lines(form, code=CODE, **more):
    environment = {
        key: value for key, value in os.environ.items() if key not in {"BM_LOG_FORMAT", "ROSBAYES_PARENT"}
    }
    environment |= {"BM_LOG_FORMAT": form} | more
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
        check=True,
        env=environment,
    )
    return done.stderr.splitlines()


@pytest.mark.thorough
def test_text_is_as_ever():
    first, *rest = lines("")
    assert re.fullmatch(r"\d\d:\d\d:\d\d\.\d{3} master: warning: frame=17 board 2 is gone\\n cycles=3", first)
    assert rest[:6] == [
        "hub: listening",
        "hub: warning: it is late",
        "error: no robot",
        "Traceback",
        "  line",
        "a library complains",
    ]
    assert rest[-1] == r"websockets: odd \x1b"


@pytest.mark.thorough
def test_dated_lines_begin_with_date_time_and_offset():
    found = lines("dated")
    assert len(found) == 10
    assert all(re.match(STAMP, line) for line in found)
    assert found[5].endswith(":00       line")
    assert sum("of a child" in line for line in found) == 2


IMITATING = """
import logging
from terminal.logs import get_logger
from terminal.output import relay
get_logger("master", "debug")
line = '2026-01-01T00:00:00.000000+00:00 master: fine'
record = '{"time": "2026-01-01T00:00:00", "level": "info", "process": "master", "message": "fine"}'
try:
    raise ValueError(f"odd\\n{line}\\n{record}\\nmaster: fine")
except ValueError:
    logging.getLogger("websockets").exception("failed", stack_info=True)
relay('{"time": "2026-01-01T00:00:00 and so on', "pcie-app")
"""


@pytest.mark.thorough
def test_a_traceback_of_a_library_imitates_no_line():
    dated = lines("dated", code=IMITATING)
    assert all(re.match(STAMP, line) for line in dated)
    records = [line for line in dated if re.match(STAMP + r"\S", line)]
    assert [line.split(" ")[1] for line in records] == ["websockets:", "pcie-app:"]
    assert len(dated) > 6
    found = [json.loads(line) for line in lines("json", code=IMITATING)]
    assert [each["process"] for each in found] == ["-c", "pcie-app"]
    assert "fine" in found[0]["traceback"]


@pytest.mark.process
def test_json_is_one_object_per_line():
    written = lines("json")
    found = [json.loads(line) for line in written[:7]]
    assert [(each.get("level"), each["message"]) for each in found] == [
        ("warning", "board 2 is gone\n"),
        ("info", "hub: listening"),
        ("warning", "it is late"),
        ("error", "no robot"),
        ("info", "Traceback\n  line"),
        ("info", "a library complains"),
        ("info", "of a child"),
    ]
    assert [each.get("process") for each in found] == ["master", *["board3"] * 4, "pcie-app", "x"]
    assert (found[0]["frame"], found[0]["cycles"], found[0]["reason"]) == (17, 3, "failed")
    assert re.match(r"\d{4}-\d\d-\d\dT", found[0]["time"])
    last = json.loads(written[-1])
    assert (last["level"], last["message"], last["logger"]) == ("error", "odd \x1b", "websockets")
    assert all(line.isprintable() for line in written)


@pytest.mark.thorough
def test_the_error_of_a_child_remains_text_for_its_parent():
    assert "error: no robot" in lines("json", ROSBAYES_PARENT="1")


@pytest.mark.parametrize("value", ["", "xml"])
def test_another_value_is_text(monkeypatch, value):
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
