"""The main function of a script: a coroutine within a time limit, errors in one sentence, and tables of results."""

import asyncio
import sys
from collections.abc import Awaitable, Callable, Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bridge.errors import BridgeError
from services.errors import StackError
from terminal.errors import ExitCode, ProcessError, StoppedError
from terminal.signals import run_async
from toolchain.errors import ToolchainError

ROOT = Path(__file__).resolve().parents[2]


def run_script(work: Callable[[], Awaitable[int]], limit: float) -> int:
    """Run a script's coroutine with a time limit, and report an error in one sentence.

    Returns:
        The exit code.
    """

    async def limited() -> int:
        try:
            return await asyncio.wait_for(work(), limit)
        except TimeoutError:
            raise StackError(f"this did not end within {limit:.0f} s") from None

    return reporting_errors(lambda: run_async(limited()))


def reporting_errors(work: Callable[[], int]) -> int:
    """Run a function and return its exit code.

    If the function raises an error, report the error in one sentence, and return the error's exit code.
    """
    try:
        return work()
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        return stopped.exit_code
    except (ProcessError, StackError, BridgeError, ToolchainError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"error: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        return ExitCode.USAGE


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str] | None], *, left: int = 1
) -> None:
    """Print a table with the first `left` columns aligned on the left. A None in `rows` ends a section."""
    table = Table(title=title, title_justify="left")
    for at, column in enumerate(columns):
        table.add_column(column, justify="left" if at < left else "right")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 140).print(table)
