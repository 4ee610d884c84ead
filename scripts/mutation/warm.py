"""A process that has imported the tests, and tries each mutant in a fork of itself, which takes no time to start.

Requests and answers are lines of JSON on its standard input and output.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import select
import signal
import subprocess
import sys
import time
import types
from collections.abc import Iterator, Mapping
from typing import Any, Final

import pytest

FLAGS: Final = ("-x", "-q", "-p", "no:cacheprovider")
START_LIMIT: Final = 60.0
"""Seconds until the first test begins, and from the end of the last one to the end of the process."""
END_TIME: Final = 15.0


class Watch:
    """Pytest plugin that reports which test begins."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Report the name of a test."""
        os.write(self._descriptor, f"{nodeid}\n".encode())


def functions_of(namespace: Mapping[str, Any], module: str) -> Iterator[tuple[str, types.FunctionType]]:
    """Yield the functions and methods that a module defines."""
    for value in namespace.values():
        if isinstance(value, type) and value.__module__ == module:
            yield from functions_of(vars(value), module)
            continue
        if isinstance(value, property):
            parts = [value.fget, value.fset]
        elif isinstance(value, functools.cached_property):
            parts = [value.func]
        else:
            parts = [getattr(value, "__func__", value)]
        for part in parts:
            function = getattr(part, "__wrapped__", part)
            if isinstance(function, types.FunctionType) and function.__module__ == module:
                yield function.__qualname__, function


def replace(module: types.ModuleType) -> bool:
    """Replace the functions of an imported module that differ in its file; return whether any does."""
    spec = importlib.util.spec_from_file_location(module.__name__, module.__file__)
    assert spec is not None
    assert spec.loader is not None
    other = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = other  # the decorator of dataclasses looks there
    try:
        spec.loader.exec_module(other)
    finally:
        sys.modules[module.__name__] = module
    old, replaced = dict(functions_of(vars(module), module.__name__)), False
    for name, new in functions_of(vars(other), module.__name__):
        function = old.get(name)
        if function is None:
            continue
        if function.__code__ != new.__code__:
            function.__code__, replaced = new.__code__, True
        if repr((function.__defaults__, function.__kwdefaults__)) != repr(
            (new.__defaults__, new.__kwdefaults__)
        ):
            function.__defaults__, function.__kwdefaults__ = new.__defaults__, new.__kwdefaults__
            replaced = True
    return replaced


def run_tests(names: list[str], descriptor: int) -> int:
    """Run tests by name; return pytest's exit code."""
    return int(pytest.main([*FLAGS, *names], plugins=[Watch(descriptor)]))


def attempt(path: str, names: list[str], descriptor: int) -> int:
    """Run tests with the mutated file at `path` (empty for none), in a fork."""
    os.setsid()
    if not path:
        return run_tests(names, descriptor)
    module = next((each for each in [*sys.modules.values()] if getattr(each, "__file__", None) == path), None)
    if module is None or not replace(module):
        command = [sys.executable, "-P", "-m", "scripts.mutation.warm", "once", str(descriptor)]
        return subprocess.call([*command, json.dumps(names)], pass_fds=[descriptor])
    return run_tests(names, descriptor)


def wait(pid: int, descriptor: int, limits: Mapping[str, float]) -> tuple[int | None, str]:
    """Return the status of a fork, None after a time limit, and the test that was running."""
    current, pending, deadline = "", b"", time.monotonic() + START_LIMIT
    while True:
        readable, _, _ = select.select([descriptor], [], [], 0.02)
        if readable:
            pending += os.read(descriptor, 1 << 16)
            *begun, pending = pending.split(b"\n")
            if begun:
                current = begun[-1].decode()
                deadline = time.monotonic() + limits.get(current, START_LIMIT)
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), current
        if time.monotonic() > deadline:
            break
        if readable:
            time.sleep(0.01)
    os.kill(pid, signal.SIGTERM)
    for number in (signal.SIGKILL, 0):
        end = time.monotonic() + END_TIME
        while time.monotonic() < end:
            if os.waitpid(pid, os.WNOHANG)[0]:
                return None, current
            time.sleep(0.02)
        os.kill(pid, number)
    return None, current


def serve(tests: list[str]) -> int:
    """Collect tests, then answer requests until the end of the standard input."""
    answers = os.fdopen(os.dup(1), "w")
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)
    os.dup2(null, 2)
    code = pytest.main(["--collect-only", *FLAGS, *tests])
    print(json.dumps(int(code)), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        receiving, sending = os.pipe()
        pid = os.fork()
        if pid == 0:
            code = 3
            try:
                os.dup2(null, 0)
                os.close(receiving)
                code = attempt(request["path"], list(request["limits"]), sending)
            finally:
                os._exit(code)
        os.close(sending)
        answer = wait(pid, receiving, request["limits"])
        os.close(receiving)
        print(json.dumps(answer), file=answers, flush=True)
    return 0


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["once", descriptor, names]:
            os._exit(run_tests(json.loads(names), int(descriptor)))
        case tests:
            sys.exit(serve(tests))
