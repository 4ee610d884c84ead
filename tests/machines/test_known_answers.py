"""A machine that is small enough to compute each cycle by hand.

4 lines, the prior and one sensor, 2-bit codes, LFSR8, one step a clock. Its generators show (low 2 bits):

cycle             1        2        3        4        5        6        7        8        9
bank 0, column 0  10101111 01011111 10111110 01111100 11111001 11110010 11100101 11001010 10010100
                        3        3        2        0        1        2        1        2        0
bank 0, column 1  10010100 00101000 01010000 10100001 01000010 10000100 00001001 00010011 00100111
                        0        0        0        1        2        0        1        3        3
bank 1, column 0  10011111 00111111 01111111 11111111 11111110 11111100 11111000 11110000 11100001
                        3        3        3        3        2        0        0        0        1
bank 1, column 1  11100001 11000010 10000101 00001011 00010111 00101111 01011110 10111100 01111000
                        1        2        1        3        3        3        2        0        0

line  prior  sensor   counts in cycles of bank 0     of bank 1
0     2      3 = 1    4 5 7 9 10 11 12               6 7 8 9
1     3 = 1  1        1 2 3 6                        8 9
2     1      2        4                              8
3     0      3 = 1    never                          never
"""

import numpy as np
import pytest

from machines.bm1 import BM1Machine, Start, StopReason
from machines.parameters import BM1Parameters, RngKind, RngReset
from machines.reference import ReferenceBM1

PRIOR = [2, 3, 1, 0]
SENSOR = [3, 1, 2, 3]
MISSING = [3, 3, 3, 3]


def tiny(**changes):
    parameters = {
        "lines": 4,
        "sensor_bits": (1,),
        "prob_bits": 2,
        "rng": RngKind.LFSR8,
        "steps_per_clock": 1,
        "rng_banks": 2,
        **changes,
    }
    tables = (np.array([SENSOR, MISSING]),) if parameters["sensor_bits"] else ()
    return BM1Machine(BM1Parameters(**parameters), np.array([PRIOR]), tables)


def start(**changes):
    return Start(**{"addresses": (0,), "target_count": 4, "max_cycles": 12, **changes})


def shown(kernel):
    states = " ".join(f"{state:08b}" for state in kernel.rng_state.ravel().tolist())
    return kernel.reason, kernel.cycles, kernel.counts.tolist(), states


OVERFLOW, MAX_CYCLES = StopReason.OVERFLOW, StopReason.MAX_CYCLES
SEEDS = (StopReason.NONE, 0, [0, 0, 0, 0], "10101111 10010100")
SIXTH = (OVERFLOW, 6, [2, 4, 1, 0], "11100101 00001001")
FIFTH = (MAX_CYCLES, 5, [2, 3, 1, 0], "11110010 10000100")


@pytest.mark.parametrize(
    ("machine", "frames"),
    [
        ({}, [({"target_count": 1}, (OVERFLOW, 1, [0, 1, 0, 0], "01011111 00101000"))]),
        ({}, [({"target_count": 3}, (OVERFLOW, 3, [0, 3, 0, 0], "01111100 10100001")), ({}, SIXTH)]),
        ({}, [({"max_cycles": 5}, FIFTH), ({"max_cycles": 5, "run_until": 5}, FIFTH)]),
        ({}, [({"max_cycles": 6}, SIXTH), ({"max_cycles": 6, "run_until": 6}, SIXTH)]),
        ({}, [({"bank": 1, "target_count": 3}, (OVERFLOW, 8, [3, 1, 1, 0], "11100001 01111000"))]),
        ({}, [({"bank": 1}, (OVERFLOW, 9, [4, 2, 1, 0], "11000010 11110001"))]),
        # line 1 counts in every cycle: both of its codes are all-ones; line 2 counts by its prior in 4 and 9
        ({}, [({"addresses": (1,), "target_count": 9}, (OVERFLOW, 9, [4, 9, 2, 0], "00101000 01001111"))]),
        # the second frame has what were cycles 4 to 5
        (
            {"rng_reset": RngReset.FREE},
            [
                ({"target_count": 3}, (OVERFLOW, 3, [0, 3, 0, 0], "01111100 10100001")),
                ({"target_count": 2, "bank": 1}, (OVERFLOW, 2, [2, 0, 1, 0], "11110010 10000100")),
            ],
        ),
        # bank 0 is column 0's as above
        (
            {"sensor_bits": ()},
            [({"addresses": (), "target_count": 7}, (OVERFLOW, 7, [3, 7, 1, 0], "11001010"))],
        ),
        # column 0 shows 3 2 1 1, column 1 shows 0 0 2 1
        ({"steps_per_clock": 2}, [({"max_cycles": 4}, (MAX_CYCLES, 4, [2, 2, 0, 0], "10010100 00100111"))]),
    ],
    ids=[
        "the first cycle sees the seeds, and the generators step after the last",
        "a line stops all after the cycle in which it reaches the target",
        "a frame ends at its last cycle",
        "an overflow in the last cycle wins",
        "all that is counted in the last cycle is kept",
        "a bank has seeds of its own",
        "a missing reading leaves the prior",
        "free generators go on from frame to frame",
        "without sensors the prior is all",
        "two steps a clock see every other state",
    ],
)
def test_frames(make, machine, frames):
    kernel = make(tiny(**machine))
    assert shown(kernel)[:3] == SEEDS[:3]
    for changes, expected in frames:
        assert kernel.start(start(**changes)) is expected[0]
        assert shown(kernel) == expected
    if machine != {"sensor_bits": ()}:
        kernel.reset()
        assert shown(kernel) == SEEDS


@pytest.mark.parametrize(
    ("reset", "states"), [(RngReset.BANK, "10011111 11100001"), (RngReset.FREE, "01111100 10100001")]
)
def test_a_machine_in_which_no_line_can_count_is_not_run(make, reset, states):
    machine = BM1Machine(
        tiny(rng_reset=reset).parameters, np.array([[0, 3, 0, 1]]), ([[3, 0, 1, 0], MISSING],)
    )
    kernel = make(machine)
    kernel.start(start(addresses=(1,), target_count=3))
    assert kernel.cycles == 3
    assert kernel.start(start(bank=1)) is StopReason.IMPOSSIBLE
    assert shown(kernel) == (StopReason.IMPOSSIBLE, 0, [0, 0, 0, 0], states)


def test_a_cell_of_its_own_generator_has_the_number_line_times_columns_plus_column():
    kernel = ReferenceBM1(tiny(sensor_bits=(), shared=False, lines=4))
    kernel.start(start(addresses=(), target_count=2))
    # The four rows of the table above, down the lines: line 0 (code 2) counts in 4, line 1 always, and line 2
    # (code 1) not yet.
    assert shown(kernel) == (OVERFLOW, 2, [0, 2, 0, 0], "10111110 01010000 01111111 10000101")


def test_an_lfsr_that_comes_round_repeats_itself(make):
    kernel = make(tiny(counter_bits=32))
    kernel.start(start(target_count=2**32 - 1, max_cycles=255))
    once = kernel.counts
    kernel.start(start(target_count=2**32 - 1, max_cycles=255 * 40))
    assert kernel.counts.tolist() == (40 * once).tolist()
    assert shown(kernel)[3] == SEEDS[3]
    # A maximal LFSR of 8 bits shows each of 1 to 3 in 64 of its 255 states, and 0 in 63.
    kernel.start(start(addresses=(1,), target_count=2**32 - 1, max_cycles=255))
    assert kernel.counts.tolist() == [127, 255, 63, 0]
