"""Pytest plugin for `coverage run`: attributes lines to tests, and writes the duration of each test that passes."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

DURATIONS = "ROSBAYES_DURATIONS"
"""Environment variable with the file for the durations."""
_seconds: dict[str, float] = {}
_failed: list[str] = []


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Measure a test with its fixtures, in a context of its own."""
    measured, began = coverage.Coverage.current(), time.perf_counter()
    if measured is not None:
        measured.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        _seconds[item.nodeid] = time.perf_counter() - began


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a test that fails."""
    if report.failed:
        _failed.append(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write the durations."""
    for name in _failed:
        _seconds.pop(name, None)
    Path(os.environ[DURATIONS]).write_text(json.dumps([_seconds, _failed]), encoding="utf-8")
