"""Verdicts and counts, shared by the verifications."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass


class CheckError(Exception):
    """A check that failed, with the reason."""


class DownloadError(Exception):
    """A download that failed, so that nothing could be checked."""


def expect(condition: bool, otherwise: str) -> None:
    """Raise an error unless a condition holds.

    Raises:
        CheckError: The condition does not hold.
    """
    if not condition:
        raise CheckError(otherwise)


@dataclass(slots=True)
class Tally:
    """Numbers of checks that passed and failed."""

    passed: int = 0
    failed: int = 0

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
