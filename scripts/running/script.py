"""The main function of a script: its coroutine within a time limit, and an error in one sentence."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

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

    try:
        return run_async(limited())
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        return stopped.exit_code
    except (ProcessError, StackError, BridgeError, ToolchainError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"error: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        return ExitCode.USAGE
