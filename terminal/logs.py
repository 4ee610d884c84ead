"""Logs: one line format for every process, on standard error."""

from __future__ import annotations

import json
import logging
import sys
from typing import TYPE_CHECKING, Any, TextIO

import orjson
import structlog

from terminal.one_line import lines_of, one_line

if TYPE_CHECKING:
    from structlog.typing import FilteringBoundLogger


class _SurvivingStream:
    """Standard error that may go away: a closed terminal must not end a robot's run by an exception."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except (OSError, ValueError):
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except (OSError, ValueError):
            return


def say(text: str) -> None:
    """A plain line for the user on standard error, even where that has been closed; whatever stands in it, it is one."""
    _write(one_line(text))


def say_lines(text: str) -> None:
    """The same of a text that has several lines, such as a traceback."""
    _write(lines_of(text))


def _write(text: str) -> None:
    stream = _SurvivingStream(sys.stderr)
    stream.write(text + "\n")
    stream.flush()


def put_json(value: Any) -> None:
    """A line of JSON on standard output, for programs; on a terminal, too, none of it is an order.

    Raises:
        OSError: standard output can't be written.
    """
    line = orjson.dumps(value)
    if not line.isascii():  # orjson has escaped what ASCII has of such characters
        text = line.decode()
        line = "".join(each if each.isprintable() else json.dumps(each)[1:-1] for each in text).encode()
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.buffer.flush()


class _OneLine(logging.Formatter):
    """What libraries log may quote a stranger; a traceback that follows has its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        return one_line(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - logging's name
        return lines_of(super().formatException(ei))


def log_by_lines() -> None:
    """Have warnings of libraries come out a line each where nothing else was arranged for them: a server's words are in some."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_OneLine())


def log_libraries(level: int, form: str) -> None:
    """Have what libraries log come out on standard error, a line each.

    Args:
        level: the least that does.
        form: how a line looks, as `logging` has it.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLine(form))
    logging.basicConfig(level=level, handlers=[handler])


def get_logger(role: str, level: str = "info") -> FilteringBoundLogger:
    """The logger of a process; every line says which process, and the frame where there is one.

    Args:
        role: the process's name, for example "subscriber".
        level: the least that is written: debug, info or warning. The first call in a process decides.
    """
    # what the libraries log, our own records say in words; only their errors are news
    log_libraries(logging.ERROR, "%(name)s: %(message)s")
    if not structlog.is_configured():
        _configure(level)
    logger: FilteringBoundLogger = structlog.get_logger().bind(process=role)
    return logger


def _configure(level: str) -> None:
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="%H:%M:%S.%f", utc=False),
            _one_line,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=structlog.PrintLoggerFactory(file=_SurvivingStream(sys.stderr)),  # type: ignore[arg-type]  # only write and flush are used
        cache_logger_on_first_use=True,
    )


def _one_line(_: Any, level: str, event: structlog.typing.EventDict) -> str:
    """`12:00:00.123 master: warning: frame=7 the event cycles=512`: no level where it is mere information.

    The frame comes before the sentence, so that a space follows it: `grep 'frame=7 '` finds no frame 70.
    """
    time, process, sentence = str(event.pop("timestamp"))[:12], event.pop("process"), event.pop("event")
    event.pop("level", None)
    frame = f"frame={event.pop('frame')} " if "frame" in event else ""
    rest = "".join(f" {key}={_value(value)}" for key, value in event.items())
    urgency = "" if level == "info" else f"{level}: "
    return one_line(f"{time} {process}: {urgency}{frame}{sentence}{rest}")


def _value(value: Any) -> str:
    """A value as logfmt has it: in quotation marks where it has spaces."""
    text = str(value)
    return json.dumps(text) if not text or set(text) & set(' ="') else text
