"""How a subcommand ends that the toolchain refuses: one sentence on stderr, and the error's exit code."""

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from toolchain.errors import ToolchainError


@contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what the toolchain refuses into one sentence and its exit code."""
    try:
        yield
    except ToolchainError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(error.exit_code) from None
