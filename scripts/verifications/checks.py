"""Verdicts and counts, shared by the verifications."""

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass


class CheckError(Exception):
    """A check that failed, with the reason."""


class DownloadError(Exception):
    """A download that failed, so that nothing could be checked."""


def expect(condition: bool, otherwise: str) -> None:
    """Raise a CheckError unless a condition holds."""
    if not condition:
        raise CheckError(otherwise)


@contextlib.asynccontextmanager
async def within(seconds: float, otherwise: str) -> AsyncIterator[None]:
    """Raise a `CheckError` if the block does not end in time."""
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError:
        raise CheckError(f"{otherwise} within {seconds:g} s") from None


@dataclass(slots=True)
class Tally:
    """Numbers of checks that passed and failed."""

    passed: int = 0
    failed: int = 0

    @contextlib.contextmanager
    def check(
        self, name: str, *errors: type[Exception], details: Callable[[], str] = lambda: ""
    ) -> Iterator[None]:
        """Run the block as a check, and report the result.

        If the block raises a CheckError or one of `errors`, the check fails, and the report has the text of `details`.
        """
        started, why = time.monotonic(), None
        known: tuple[type[Exception], ...] = (CheckError, *errors)
        try:
            yield
        except known as error:
            why = str(error) or type(error).__name__
        self.report(name, started, why, details() if why else "")

    def report(self, name: str, started: float, why: str | None, details: str = "") -> None:
        """Print one check's line, and details below it."""
        self.passed += why is None
        self.failed += why is not None
        took = f"({time.monotonic() - started:.1f} s)"
        print(f"ok   {name} {took}" if why is None else f"FAIL {name}: {why} {took}")
        if details:
            print(details)
        sys.stdout.flush()

    def end(self) -> int:
        """Print the counts, and return the exit code, which is also 1 if a flag selected nothing."""
        print(f"{self.passed} passed, {self.failed} failed")
        return 1 if self.failed or not self.passed else 0
