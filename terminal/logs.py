"""Logging to standard error, in one line format for every process."""

import json
import logging
import sys
from typing import Any

import structlog
from structlog.typing import FilteringBoundLogger

from terminal.one_line import lines_of, one_line
from terminal.output import SurvivingStream


class _OneLine(logging.Formatter):
    """Formatter with one line per record: a library may quote untrusted text. Tracebacks keep their lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name in logging
        return one_line(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - the name in logging
        return lines_of(super().formatException(ei))


def escape_last_resort() -> None:
    """Escape warnings of libraries if logging is not configured, because some quote a server."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_OneLine())


def log_libraries(level: int, form: str) -> None:
    """Write log records of libraries from a level on to standard error, one line each."""
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLine(form))
    logging.basicConfig(level=level, handlers=[handler])


def get_logger(role: str, level: str = "info") -> FilteringBoundLogger:
    """Return the logger of a process; its lines contain its name, and the number of the frame if any.

    The first call in a process sets the minimum level: debug, info or warning.
    """
    # our own records cover the warnings of libraries; only their errors are new
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
        logger_factory=structlog.PrintLoggerFactory(file=SurvivingStream(sys.stderr)),  # type: ignore[arg-type]  # only write and flush are used
        cache_logger_on_first_use=True,
    )


def _one_line(_: Any, level: str, event: structlog.typing.EventDict) -> str:
    """Format `12:00:00.123 master: warning: frame=7 the event cycles=512`, without the level if it is info.

    The frame precedes the sentence and is followed by a space, so `grep 'frame=7 '` does not find frame 70.
    """
    time, process, sentence = str(event.pop("timestamp"))[:12], event.pop("process"), event.pop("event")
    event.pop("level", None)
    frame = f"frame={event.pop('frame')} " if "frame" in event else ""
    rest = "".join(f" {key}={_value(value)}" for key, value in event.items())
    prefix = "" if level == "info" else f"{level}: "
    return one_line(f"{time} {process}: {prefix}{frame}{sentence}{rest}")


def _value(value: Any) -> str:
    """Return a value in logfmt: quoted if it contains spaces."""
    text = str(value)
    return json.dumps(text) if not text or set(text) & set(' ="') else text
