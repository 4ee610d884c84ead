"""Both kernels, for tests that both must pass."""

import pytest

from machines.fast import FastBM1
from machines.reference import ReferenceBM1


@pytest.fixture(params=[ReferenceBM1, FastBM1])
def make(request):
    """A kernel's class, each in turn."""
    return request.param
