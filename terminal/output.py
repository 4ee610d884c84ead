"""Standard output and standard error: text lines for people, JSON lines for programs."""

import contextlib
import json
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import orjson

from terminal.errors import OutputError
from terminal.logs import LogFormat, formatted, log_format, relayed, write_line, write_progress
from terminal.one_line import one_line

ERROR_DESCRIPTOR: Final = "ROSBAYES_ERROR_DESCRIPTOR"
"""Environment variable with the file descriptor to which a child writes its error for its parent, as a JSON line."""


def say(text: str) -> None:
    """Print one line for the user on standard error. If standard error is closed, do nothing."""
    write_line(formatted("info", one_line(text)))


def warn(sentence: str, *, name: str = "") -> None:
    """Print a warning in one line on standard error. In the text format, the line begins with the process's `name`."""
    write_line(formatted("warning", one_line(sentence), name=name))


def say_error(sentence: str) -> None:
    """Print the error that ends this process. If `ERROR_DESCRIPTOR` is set, send the error to the parent instead."""
    descriptor = os.environ.get(ERROR_DESCRIPTOR, "")
    if descriptor.isdigit():
        with contextlib.suppress(OSError):  # the parent may be gone
            os.write(int(descriptor), json.dumps({"error": sentence}).encode() + b"\n")
            return
    write_line(formatted("error", one_line(sentence)))


def show_progress(text: str) -> None:
    """Show the progress of this command in one line of the terminal. The next output replaces the line.

    In the JSON log format, each call writes a new line.
    """
    if log_format() is LogFormat.JSON:
        say(text)
        return
    # a longer one could not be replaced
    write_progress(one_line(text)[: shutil.get_terminal_size().columns - 1])


@contextlib.contextmanager
def say_if_slow(text: str, *, after_s: float = 2.0) -> Iterator[None]:
    """Print one line for the user if the context lasts longer than `after_s`."""
    timer = threading.Timer(after_s, say, (text,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def say_lines(text: str) -> None:
    """Print a text of several lines, such as a traceback, on standard error."""
    write_line(formatted("info", text))


def relay(line: str, process: str) -> None:
    """Print a line from a child's standard error on the standard error of this process."""
    write_line(relayed(line, process))


def print_json_line(value: Any) -> None:
    """Print a value as a line of JSON on standard output. Terminal control characters are escaped."""
    line = orjson.dumps(value)
    if not line.isascii():  # orjson escapes only the control characters of ASCII
        text = line.decode()
        line = "".join(each if each.isprintable() else json.dumps(each)[1:-1] for each in text).encode()
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.buffer.flush()


def open_standard_streams() -> None:
    """Open /dev/null for each closed standard stream (`>&-`), so that no other file gets the stream's descriptor."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def discard_output() -> None:
    """Redirect standard output to /dev/null after a failed write, so that flushing at exit cannot fail."""
    with contextlib.suppress(OSError), Path(os.devnull).open("wb") as null:
        os.dup2(null.fileno(), sys.stdout.fileno())


def check_writable(folder: Path) -> None:
    """Create a folder if necessary, and check before a long run that files can be written there.

    Raises an OutputError if the folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written to: {error.strerror or error}; name another folder"
        ) from None


def write_json(path: Path, values: Mapping[str, object]) -> None:
    """Write one JSON object to a file, or raise an OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(values, indent=1) + "\n")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from None
