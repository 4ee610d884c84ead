"""How a subcommand ends that the toolchain refuses: one sentence on stderr, and the error's exit code."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from terminal.one_line import one_line
from toolchain.errors import ToolchainError


@contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what the toolchain refuses into one sentence and its exit code; what the system refuses of a path, too."""
    try:
        yield
    except ToolchainError as error:
        typer.echo(one_line(f"error: {error}"), err=True)
        raise typer.Exit(error.exit_code) from None
    except OSError as error:
        # no file has failed where nobody reads on (`| head`): typer ends that quietly
        if error.filename is None or error.errno == errno.EPIPE:
            raise
        typer.echo(one_line(f"error: {error.filename}: {error.strerror}"), err=True)
        raise typer.Exit(ToolchainError.exit_code) from None
