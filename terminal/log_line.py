"""One line on standard error: as text, as dated text, or as a JSON object.

The format is that of `BM_LOG_FORMAT`, which children inherit.
"""

import json
import os
import re
import sys
from collections.abc import Mapping
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from terminal.one_line import lines_of, one_line

PARENT_VARIABLE: Final = "ROSBAYES_PARENT"
"""Environment variable that a process sets for its children, which exit with it and report nothing."""
FORMAT_VARIABLE: Final = "BM_LOG_FORMAT"

_ERROR: Final = "error: "
_WARNING: Final = re.compile(r"(?:[\w-]+: )?warning: ")
_DATED: Final = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+[+-]\d\d:\d\d ")
_IS_CHILD: Final = PARENT_VARIABLE in os.environ


class _OwnName:
    """Name of this process if it is not that of its command."""

    value = ""


class LogFormat(StrEnum):
    """A format of the lines on standard error."""

    TEXT = "text"
    DATED = "dated"
    JSON = "json"


def log_format() -> LogFormat:
    """Return the format in force; that of an invalid variable, which the settings report, is text."""
    value = os.environ.get(FORMAT_VARIABLE, "")
    return LogFormat(value) if value in set(LogFormat) else LogFormat.TEXT


def use_log_format(value: str) -> None:
    """Use this format from now on, in this process and in its later children."""
    os.environ[FORMAT_VARIABLE] = value


def name_process(name: str) -> None:
    """Set the name of this process in its JSON lines, which is otherwise that of its command."""
    _OwnName.value = name


def process_name() -> str:
    """Return the name of this process: that of its command."""
    if _OwnName.value:
        return _OwnName.value
    name = Path(sys.argv[0]).stem
    return sys.argv[1] if name in {"rosbayes", "__main__"} and len(sys.argv) > 1 else name


def now() -> str:
    """Return the local date and time with its offset from UTC."""
    return datetime.now().astimezone().isoformat(timespec="microseconds")


def json_line(level: str, message: str, *, process: str = "", **fields: object) -> str:
    """Return a JSON object on one line, in ASCII."""
    line = {"time": now(), "level": level, "process": process or process_name(), "message": message}
    return json.dumps(line | fields, default=str)


def dated_lines(text: str) -> str:
    """Return the lines of a text, each with date and time if that is the format in force.

    Lines after the first are indented then, so that untrusted text in a traceback cannot imitate a record.
    """
    text = lines_of(text)
    if log_format() is not LogFormat.DATED:
        return text
    time = now()
    return f"{time} " + text.replace("\n", f"\n{time}     ")


def formatted(text: str) -> str:
    """Return a text for the user in the format in force.

    The `error: ` of a child remains text, because its parent reports it.
    """
    if _IS_CHILD and text.startswith(_ERROR):
        return lines_of(text)
    if log_format() is not LogFormat.JSON:
        return dated_lines(text)
    if text.startswith(_ERROR):
        return json_line("error", text.removeprefix(_ERROR))
    if found := _WARNING.match(text):
        return json_line("warning", text[found.end() :])
    return json_line("info", text)


def relayed(line: str, process: str) -> str:
    """Return a line of a child in the format in force; most have it already."""
    form = log_format()
    if form is LogFormat.TEXT or _is_record(line, form):
        return one_line(line)
    return (
        one_line(f"{now()} {process}: {line}")
        if form is LogFormat.DATED
        else json_line("info", line, process=process)
    )


def _is_record(line: str, form: LogFormat) -> bool:
    """Return whether a line has a format already: that of a child of the same version."""
    if form is LogFormat.DATED:
        return _DATED.match(line) is not None
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return False
    return isinstance(record, dict) and {"time", "level", "process", "message"} <= record.keys()


def logged(level: str, process: str, sentence: str, fields: Mapping[str, Any]) -> str:
    """Return a record of the log in the format in force.

    The text is `12:00:00.123 master: warning: frame=7 the event cycles=512`, without the level if it is info.
    The frame precedes the sentence and is followed by a space, so `grep 'frame=7 '` does not find frame 70.
    Fields whose names begin with `_` are only in JSON.
    """
    form = log_format()
    if form is LogFormat.JSON:
        return json_line(level, sentence, process=process, **{key.lstrip("_"): fields[key] for key in fields})
    rest = {key: value for key, value in fields.items() if not key.startswith("_")}
    frame = f"frame={rest.pop('frame')} " if "frame" in rest else ""
    pairs = "".join(f" {key}={_value(value)}" for key, value in rest.items())
    prefix = "" if level == "info" else f"{level}: "
    time = now() if form is LogFormat.DATED else f"{datetime.now().astimezone():%H:%M:%S.%f}"[:12]
    return one_line(f"{time} {process}: {prefix}{frame}{sentence}{pairs}")


def _value(value: Any) -> str:
    """Return a value in logfmt: quoted if it contains spaces."""
    text = str(value)
    return json.dumps(text) if not text or set(text) & set(' ="') else text
