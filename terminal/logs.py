"""Logging to standard error, in one line format for every process."""

import logging
from typing import Any

import structlog
from structlog.typing import FilteringBoundLogger

from terminal.log_line import LogFormat, dated_lines, json_line, log_format, logged
from terminal.one_line import lines_of, one_line
from terminal.output import write_line


class _StandardError:
    """Destination of structlog: a method for each level, which prints the line."""

    def info(self, line: str) -> None:
        write_line(line)

    debug = warning = error = critical = info


class _OneLine(logging.Formatter):
    """Formatter with one line per record: a library may quote untrusted text. Tracebacks keep their lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return one_line(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        if log_format() is not LogFormat.JSON:
            return dated_lines(super().format(record))
        fields = {"logger": record.name}
        if record.exc_info:
            fields["traceback"] = super().formatException(record.exc_info)
        return json_line(record.levelname.lower(), record.getMessage(), **fields)

    def formatException(self, ei: Any) -> str:
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
            _line,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=_StandardError,
        cache_logger_on_first_use=True,
    )


def _line(_: Any, level: str, event: structlog.typing.EventDict) -> str:
    return logged(level, event.pop("process"), event.pop("event"), event)
