"""The resource estimator beside a synthesis, and the synthesised text beside the reference machine.

Runs `tests/verification/resources`, a line for each machine.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.verifications.debian import MissingToolError, install

FOLDER = Path(__file__).parents[2] / "tests" / "verification" / "resources"


class Report:
    """A pytest plugin that prints a line for each test, and counts them.

    Args:
        only: Run tests whose machine's description has this in it.
    """

    def __init__(self, only: str) -> None:
        self._only = only
        self.passed = 0
        self.failed = 0

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the tests of the chosen machines."""
        items[:] = [item for item in items if self._only in item.name]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Print a test's verdict, with the figures that it recorded."""
        if report.when != "call" and report.passed:
            return
        self.passed += report.passed
        self.failed += not report.passed
        kind = "simulated as the reference" if "simulation" in report.nodeid else "estimate / synthesis"
        figures = ", ".join(str(value) for _, value in report.user_properties)
        name = report.nodeid.partition("[")[2][:-1]
        print(f"{'ok  ' if report.passed else 'FAIL'}  {kind}: {name}: {figures}", flush=True)
        if not report.passed:
            print(report.longreprtext)


def main() -> int:
    """Simulate, then synthesise; exit 1 if anything differs."""
    parser = argparse.ArgumentParser(prog="scripts/verify resources", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--simulate-only", action="store_true", help="leave the synthesis out (no yosys needed)"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="synthesise the machines that the estimator is calibrated on, and fit its costs again",
    )
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="machines whose description has this in it"
    )
    arguments = parser.parse_args()
    tools = [] if arguments.calibrate else ["iverilog"]
    tools += [] if arguments.simulate_only else ["yosys"]
    try:
        install({tool: tool for tool in tools})
    except MissingToolError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if arguments.calibrate:
        return subprocess.run(
            [sys.executable, "-P", "-m", "tests.verification.resources.synthesis"], check=False
        ).returncode
    files = [FOLDER / "test_simulation.py"]
    files += [] if arguments.simulate_only else [FOLDER / "test_synthesis.py"]
    report = Report(arguments.only)
    options = ["-o", "addopts=--import-mode=importlib", "-m", "verification", "-p", "no:terminal"]
    pytest.main([*options, *map(str, files)], plugins=[report])
    print(f"{report.passed} passed, {report.failed} failed")
    if not report.passed + report.failed:
        print(f"error: no machine's description has {arguments.only!r} in it", file=sys.stderr)
    return 1 if report.failed or not report.passed else 0


if __name__ == "__main__":
    sys.exit(main())
