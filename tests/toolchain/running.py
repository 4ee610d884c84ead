"""The `toolchain` command within a test's process, and code shared by the tests of several rooms."""

import tracemalloc
from contextlib import contextmanager
from dataclasses import replace

import pytest

from tests.command_runner import invoke
from toolchain.building.build import build_deployment
from toolchain.building.machine import plan_machine
from toolchain.building.options import BuildOptions
from toolchain.commands.main import app

TARGET = ("--uri", "ws://robot:9090", "--topic", "/readings", "--type", "std_msgs/msg/Float64")

OPTIONS = BuildOptions(uri="ws://robot:9090", topic="/readings", type="std_msgs/Float64MultiArray")


TINY = """
import numpy as np
from toolchain.models.model import Known, Model, dimension

def model(size: int = 4, bits: int = 0):
    return Model(name="tiny", searched=(dimension("s", size=size),),
                 known=(Known(name="K", table=np.full((2, size), 0.5), bits=bits),))
"""
"""A `MODEL` of the fixture `case`: one known variable that tells nothing."""


def build_model(model, folder, **options):
    """Build a model into a folder with the usual options but for some."""
    return build_deployment(plan_machine(model, replace(OPTIONS, **options)), folder)


def toolchain(*arguments):
    """Run the command; the result has `exit_code`, `stdout` and `stderr`."""
    return invoke(app, arguments)


def done(result):
    """Assert that a command succeeded, and return its result."""
    assert result.exit_code == 0, result.output
    return result


def assert_refused(result, *named):
    """Assert that a command ended with exit code 2 and one sentence that has these names and values in it."""
    assert (result.exit_code, result.stdout) == (2, "")
    sentence = result.stderr.splitlines()[-1]
    assert sentence.startswith("error: ")
    assert "Traceback" not in result.stderr
    for each in named:
        assert str(each) in sentence


def contents(folder):
    """Return the bytes of every file below a folder, by its relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def refused_within(limit, error):
    """Expect an error in the block, and that at most so many bytes are allocated on the way to it."""
    tracemalloc.start()
    try:
        with pytest.raises(error) as caught:
            yield caught
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()
