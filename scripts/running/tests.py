"""Runs of all tests, one kind of test after the other (see scripts/test)."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from scripts.running.script import ROOT

FLAKY_MOST = 2
"""Maximum number of tests with processes that may fail at first, if they pass when they are run again alone."""


def pytest(*arguments: str) -> tuple[int, list[str]]:
    """Run pytest; return its exit code and the tests that failed."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", "pytest", "-o", f"cache_dir={cache}", *arguments]
        code = subprocess.run(command, cwd=ROOT, check=False).returncode
        failed = Path(cache) / "v" / "cache" / "lastfailed"
        return code, list(json.loads(failed.read_text())) if failed.exists() else []


def main() -> int:
    """Run all kinds, print the failures at the end, and return the exit code."""
    kinds = [
        ("tests without processes", ("-m", "not process and not thorough", "-n", "2", "--dist", "worksteal")),
        ("tests with processes", ("-m", "process and not thorough")),
    ]
    if sys.argv[1:] == ["--all"]:
        kinds.append(("thorough tests", ("-m", "thorough", "-n", "2", "--dist", "worksteal")))
    failed: list[str] = []
    once: list[str] = []
    """Tests with processes that failed once; they run again, because a disturbance by other programs does not recur."""
    for name, flags in kinds:
        print(f"-- {name}", flush=True)
        code, names = pytest(*flags, "--durations", "10")
        if code and not names:  # not a test, but pytest or the collection of tests
            names = [f"pytest, with exit code {code}"]
            failed += names
        elif name == kinds[0][0]:
            failed += names
        else:
            once += names
    if once and not failed:
        print("-- failed tests with processes, once more and alone", flush=True)
        code, names = pytest(*once)
        failed += names or ([f"pytest, with exit code {code}"] if code else [])
        flaky = [each for each in once if each not in names]
        for each in flaky:
            print(f"FLAKY {each}")
        if len(flaky) > FLAKY_MOST:
            print(f"more than {FLAKY_MOST} tests are flaky")
            failed += flaky
    else:
        failed += once
    for each in failed:
        print(f"FAILED {each}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
