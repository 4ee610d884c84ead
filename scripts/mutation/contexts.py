"""Pytest plugin for `coverage run`: attributes lines to tests, and writes the duration of each test."""

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


def pytest_sessionfinish() -> None:
    """Write the durations."""
    Path(os.environ[DURATIONS]).write_text(json.dumps(_seconds), encoding="utf-8")
