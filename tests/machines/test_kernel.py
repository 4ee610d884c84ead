"""Which kernel a machine gets, and what is loaded for it."""

import subprocess
import sys

import numpy as np
import pytest

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason
from machines.fast import FastBM1
from machines.parameters import BM1Parameters, RngKind
from machines.reference import ReferenceBM1
from tests.patience import PROCESS_PATIENCE


@pytest.mark.parametrize("kind", RngKind)
@pytest.mark.parametrize("shared", [True, False])
def test_the_fast_one_where_it_can(kind, shared):
    parameters = BM1Parameters(lines=2, sensor_bits=(1,), prob_bits=7, rng=kind, shared=shared)
    rng_table = np.random.default_rng(1).integers(0, 2**32, 1000, dtype=np.uint32)
    machine = BM1Machine(
        parameters,
        np.full((1, 2), 100),
        (np.full((2, 2), 127),),
        rng_table if kind is RngKind.TABLE else None,
    )
    kernel = make_kernel(machine)
    assert type(kernel) is (FastBM1 if shared and kind in (*RngKind,)[:4] else ReferenceBM1)
    assert kernel.start(Start(addresses=(0,), target_count=20, max_cycles=1000)) is StopReason.OVERFLOW
    assert kernel.counts.max() == 20


def test_a_machine_with_too_many_codes_for_the_fast_kernel_gets_the_reference():
    parameters = BM1Parameters(lines=1, sensor_bits=(16,) * 256, prob_bits=16, sensor_mode="threshold")
    assert type(make_kernel(BM1Machine(parameters, np.full((1, 1), 100), ()))) is ReferenceBM1


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("module", "late"),
    [
        *((name, "numba") for name in ("bm1", "encode", "posterior", "kernel", "reference", "rng")),
        *(("parameters", late) for late in ("numba", "numpy")),
    ],
)
def test_a_library_is_not_loaded_before_it_is_needed(module, late):
    code = f"import sys, machines.{module}; sys.exit('{late}' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PROCESS_PATIENCE).returncode == 0
