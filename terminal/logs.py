"""Lines on standard error, in one format for every process: text, or one JSON object per line.

    say, show_progress (terminal.output) ──┐
    get_logger ────────────────────────────┼──▶ text or JSON ──▶ write_line ──▶ standard error
    logging of libraries ──────────────────┤
    relayed lines of children ─────────────┘

`BM_LOG_FORMAT` selects the format, also for child processes. Text from a peer is escaped, so that it can neither begin
a line nor control a terminal.
"""

import json
import logging
import os
import sys
from contextlib import suppress
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Final

from terminal.one_line import lines_of, one_line

PARENT_VARIABLE: Final = "ROSBAYES_PARENT"
"""Environment variable with the parent's process id. A child with this variable exits when its parent exits."""
FORMAT_VARIABLE: Final = "BM_LOG_FORMAT"

_CLEAR_LINE: Final = "\r\x1b[K"
_QUOTED: Final = frozenset(" \t=\r\n\"'")
"""Characters for which a value is quoted, because in a text line they would end the value or begin another field."""


class _Process:
    """State of this process's output on standard error."""

    name = ""
    """The name of the process in JSON lines, set at start-up. It is empty if the command's name is used."""
    shows_progress = False
    """True while the last line of the terminal shows progress, which the next line replaces."""


class LogFormat(StrEnum):
    """A format of the lines on standard error."""

    TEXT = "text"
    JSON = "json"


def log_format() -> LogFormat:
    """Return the log format, or `TEXT` if the environment variable is invalid. The settings report the error."""
    value = os.environ.get(FORMAT_VARIABLE, "")
    return LogFormat(value) if value in set(LogFormat) else LogFormat.TEXT


def use_log_format(value: str) -> None:
    """Use a log format from now on, in this process and in its later children."""
    os.environ[FORMAT_VARIABLE] = value


def name_process(name: str) -> None:
    """Set the name of this process in its JSON log lines. The default is the name of the command."""
    _Process.name = name


def _own_name() -> str:
    name = Path(sys.argv[0]).stem
    is_umbrella = name in {"rosbayes", "__main__"} and len(sys.argv) > 1
    return _Process.name or (sys.argv[1] if is_umbrella else name)


# --- lines ------------------------------------------------------------------------------------------


def json_line(level: str, message: str, *, process: str = "", **fields: object) -> str:
    """Return a JSON object on one line, in ASCII."""
    record = {"level": level, "process": process or _own_name(), "message": message, **fields, "time": _now()}
    return json.dumps(record, default=str)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def formatted(level: str, text: str, *, name: str = "") -> str:
    """Return a text for the user in the current log format.

    In JSON, an object contains the level and the text. Otherwise the result is `name: level: text`, or the text alone
    if the level is `info`.
    """
    if log_format() is LogFormat.JSON:
        return json_line(level, text)
    prefix = f"{name}: " if name else ""
    return lines_of(text if level == "info" else f"{prefix}{level}: {text}")


def relayed(line: str, process: str) -> str:
    """Return a child's line for the log of this process.

    If the log format is JSON and the line is not a log record, the result is a new record with the line as its
    message. In every other case, the result is the line, escaped as in `one_line`.
    """
    if log_format() is LogFormat.TEXT or _is_record(line):
        return one_line(line)
    return json_line("info", line, process=process)


def _is_record(line: str) -> bool:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return False
    return isinstance(record, dict) and {"time", "level", "process", "message"} <= record.keys()


def write_line(text: str) -> None:
    """Print a text on standard error. The text must already be in the current log format."""
    _write(text + "\n")


def write_progress(text: str) -> None:
    """Show a text on the terminal until the next line replaces it."""
    _write(text)
    _Process.shows_progress = True


def _write(text: str) -> None:
    """Replace the progress line by a text. If standard error is closed, do nothing, so that the run continues."""
    with suppress(OSError, ValueError):
        if _Process.shows_progress:
            _Process.shows_progress = False
            sys.stderr.write(_CLEAR_LINE)
        sys.stderr.write(text)
        sys.stderr.flush()


# --- loggers ----------------------------------------------------------------------------------------


class Logger:
    """The log of a process. Messages below the process's level are not logged.

    The keyword arguments of a message are its fields. A field whose name begins with `_` is only in JSON logs, where
    the name has no `_`.
    """

    def __init__(self, role: str, level: str) -> None:
        self._role = role
        self._lowest = logging.getLevelNamesMapping()[level.upper()]

    def debug(self, message: str, **fields: object) -> None:
        """Log a step of one frame."""
        self._log(logging.DEBUG, message, fields)

    def info(self, message: str, **fields: object) -> None:
        """Log a change of state."""
        self._log(logging.INFO, message, fields)

    def warning(self, message: str, **fields: object) -> None:
        """Log a problem that the user should know about, but that does not end the run."""
        self._log(logging.WARNING, message, fields)

    def _log(self, level: int, message: str, fields: dict[str, object]) -> None:
        if level < self._lowest:
            return
        name = logging.getLevelName(level).lower()
        if log_format() is LogFormat.JSON:
            known = {key.lstrip("_"): value for key, value in fields.items()}
            write_line(json_line(name, message, process=self._role, **known))
            return
        shown = {key: value for key, value in fields.items() if not key.startswith("_")}
        texts = (f"{key}={_quoted(value)}" for key, value in {"process": self._role, **shown}.items())
        write_line(one_line(f"{_now()} [{name}] {message} {' '.join(texts)}"))


def _quoted(value: object) -> str:
    text = str(value)
    return repr(text) if _QUOTED & set(text) else text


def get_logger(role: str, level: str = "info") -> Logger:
    """Return the logger of a process. Each line of the log contains the name `role` of the process."""
    # our own messages already report what libraries warn of; only their errors are new
    log_libraries(logging.ERROR, "%(name)s: %(message)s")
    return Logger(role, level)


def log_libraries(level: int, form: str) -> None:
    """Write libraries' log records of at least `level` to standard error, in the `logging` format `form`."""
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLine(form))
    logging.basicConfig(level=level, handlers=[handler])


def escape_last_resort() -> None:
    """Escape control characters in warnings that libraries log before logging is configured.

    A warning may contain text that a server sent.
    """
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_OneLine())


class _OneLine(logging.Formatter):
    """Formatter with one line per record, because a library may quote untrusted text. Tracebacks keep their lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return one_line(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        if log_format() is LogFormat.TEXT:
            return lines_of(super().format(record))
        fields = {"logger": record.name}
        if record.exc_info:
            fields["traceback"] = super().formatException(record.exc_info)
        return json_line(record.levelname.lower(), record.getMessage(), **fields)
