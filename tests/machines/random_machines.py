"""Random machines and their frames, for properties that hold for every BM1."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from machines.bm1 import BM1Machine, Start, StopReason
from machines.kernel import BM1Kernel
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode

ONE = st.just(1)
LFSRS = [kind for kind in RngKind if kind.lfsr_bits is not None]


@dataclass(frozen=True)
class Frame:
    """A start, and the cycles at which its later slices end."""

    start: Start
    slices: tuple[int, ...]


@dataclass(frozen=True)
class Session:
    """A machine and the frames that it runs one after another."""

    machine: BM1Machine
    frames: tuple[Frame, ...]


@st.composite
def sessions(draw, kinds=tuple(LFSRS), shared=(True,), replicas=ONE, modes=tuple(SensorMode)):
    """Sessions with every feature; those with many cells run fewer cycles, so that the reference keeps up."""
    replicas = draw(replicas)
    lines = draw(st.one_of(st.integers(1, 6), st.integers(1, 100), st.integers(1, 1200 // replicas)))
    sensors = draw(st.one_of(st.integers(0, 3), st.integers(0, 8), st.integers(0, 30)))
    kind = draw(st.sampled_from(kinds))
    prior_mode = draw(st.sampled_from(PriorMode))
    mode = draw(st.sampled_from(modes))
    prob_bits = draw(st.integers(1, min(16, (kind.lfsr_bits or 17) - 1)))
    widths = st.just(prob_bits) if mode is SensorMode.THRESHOLD else st.integers(1, 3)
    parameters = BM1Parameters(
        lines=lines,
        sensor_bits=tuple(draw(st.lists(widths, min_size=sensors, max_size=sensors))),
        prob_bits=prob_bits,
        prior_bits=0 if prior_mode is PriorMode.WRITTEN else draw(st.integers(0, 2)),
        prior_mode=prior_mode,
        counter_bits=draw(st.one_of(st.integers(1, 7), st.integers(8, 12), st.just(32))),
        rng=kind,
        shared=draw(st.sampled_from(shared)),
        steps_per_clock=draw(st.one_of(st.just(0), st.just(1), st.integers(1, 20))),
        rng_banks=draw(st.sampled_from([1, 2, 3, 16])),
        rng_reset=draw(st.sampled_from(RngReset)),
        ideal_seed=draw(st.integers(0, 2**64 - 1)),
        sensor_mode=mode,
        replicas=replicas,
    )
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    # From tables in which hardly anything survives (zeros, small codes) to tables of ones.
    zeros = draw(st.sampled_from([0.0, 0.0, 0.02, 0.3]))
    typical = draw(st.sampled_from([0.02, 0.3, 0.8, 0.97, 1.0]))
    machine = BM1Machine(
        parameters,
        codes(random, parameters, parameters.prior_addresses, zeros, typical, top=False),
        tuple(codes(random, parameters, 1 << bits, zeros, typical) for bits in parameters.sensor_bits)
        if parameters.has_tables
        else (),
        random.integers(0, 2**32, draw(st.integers(1, 3000)), dtype=np.uint32)
        if kind is RngKind.TABLE
        else None,
    )
    most = 3000 if replicas * lines * parameters.columns * parameters.steps_per_clock < 20_000 else 700
    frames = tuple(
        draw(st.lists(frames_of(parameters, random, zeros, typical, most), min_size=1, max_size=4))
    )
    return Session(machine, frames)


@st.composite
def frames_of(draw, parameters, random, zeros, typical, most):
    """A frame for a machine of these parameters; its readings are missing at times."""
    addresses = inputs(draw, parameters, random, zeros, typical)
    prior_codes = None
    if parameters.prior_mode is PriorMode.WRITTEN and draw(st.booleans()):
        rows = draw(st.sampled_from([1, parameters.replicas]))
        prior_codes = codes(random, parameters, rows, zeros, typical, top=False)
        prior_codes = prior_codes[0] if rows == 1 else prior_codes
    prior_addresses = st.integers(0, parameters.prior_addresses - 1)
    if parameters.replicas > 1:
        several = st.tuples(*[prior_addresses] * parameters.replicas)
        prior_addresses = st.one_of(prior_addresses, several)
    cycles = st.one_of(st.integers(1, 200), st.integers(most // 2, most), st.sampled_from([64, 512, 1024]))
    max_cycles = draw(cycles)
    ends = sorted(draw(st.sets(cycles, max_size=4)))
    start = Start(
        addresses=addresses,
        prior_address=draw(prior_addresses),
        prior_codes=prior_codes,
        target_count=draw(
            st.one_of(
                st.integers(1, min(40, parameters.target_count_max)),
                st.integers(1, min(1500, parameters.target_count_max)),
                st.just(parameters.target_count_max),
            )
        ),
        max_cycles=max_cycles,
        bank=draw(st.integers(0, parameters.rng_banks - 1)),
        run_until=ends[0] if ends else 0,
    )
    return Frame(start, (*ends[1:], draw(st.sampled_from([0, max_cycles]))) if ends else ())


def inputs(draw, parameters, random, zeros, typical):
    """A frame's sensor inputs: a tuple where every column has one, else an array; missing at times."""
    if parameters.replicas == 1 and parameters.sensor_mode is SensorMode.COLUMN:
        return tuple(
            draw(st.one_of(st.integers(0, (1 << bits) - 1), st.just((1 << bits) - 1)))
            for bits in parameters.sensor_bits
        )
    if parameters.has_tables:
        tops = (1 << np.array(parameters.sensor_bits, dtype=np.int64)) - 1
        tops = tops if parameters.sensor_mode is SensorMode.COLUMN else tops[:, np.newaxis]
        given = random.integers(0, tops + 1, parameters.input_shape)
    else:
        rows = parameters.replicas * parameters.sensors
        given = codes(random, parameters, rows, zeros, typical, top=False).reshape(parameters.input_shape)
    # one replica's column in three is missing
    columns = given.reshape(parameters.replicas * parameters.sensors, -1) if parameters.sensors else given
    for at in range(len(columns) if parameters.sensors else 0):
        if random.random() < 1 / 3:
            columns[at] = (1 << parameters.sensor_bits[at % parameters.sensors]) - 1
    return given


def codes(random, parameters, rows, zeros, typical, *, top=True):
    """A table of codes around a share of the highest one, some of them 0 and some all-ones."""
    ones = parameters.ones_code
    shape = (rows, parameters.lines)
    spread = (
        random.uniform(2 * typical - 1, 1.1, shape)
        if typical >= 0.5
        else random.uniform(0, 2 * typical, shape)
    )
    table = np.clip(np.rint(spread * ones), 1, ones).astype(np.uint16)
    table[random.random(shape) < zeros] = 0
    if top:
        table[-1] = ones
    return table


def machine_of(lines=20, sensors=3, zeros=0.0, **changes):
    """The same machine for the same arguments, of sensors with four values each."""
    threshold = changes.get("sensor_mode") is SensorMode.THRESHOLD
    parameters = BM1Parameters(
        **{"lines": lines, "sensor_bits": (8 if threshold else 2,) * sensors, "counter_bits": 32, **changes}
    )
    random = np.random.default_rng(11)
    prior = codes(random, parameters, parameters.prior_addresses, zeros, 0.8, top=False)
    tables = () if threshold else tuple(codes(random, parameters, 4, zeros, 0.8) for _ in range(sensors))
    return BM1Machine(parameters, prior, tables)


def play(kernel: BM1Kernel, frames: tuple[Frame, ...]):
    """Run the frames, and yield all that can be seen of the kernel after every start and resume."""
    for frame in frames:
        yield seen(kernel, kernel.start(frame.start))
        for at, run_until in enumerate(frame.slices):
            if kernel.reason is StopReason.SLICE and (run_until == 0 or run_until > kernel.cycles):
                sliced = [
                    replica
                    for replica, reason in enumerate(kernel.replica_reasons)
                    if reason is StopReason.SLICE and kernel.replica_cycles[replica] == kernel.cycles
                ]
                # every other time one of several that could go on is left where it stands
                halted = {sliced[-1]} if len(sliced) > 1 and at % 2 == 0 else ()
                yield seen(kernel, kernel.resume(run_until, halted))


def seen(kernel: BM1Kernel, returned: StopReason):
    """Return all that a kernel shows: reason, cycles, counts, states, and each replica's reason and cycles."""
    assert kernel.cycles == max(kernel.replica_cycles)
    assert kernel.counts.shape == kernel.machine.parameters.count_shape
    assert kernel.reason is returned
    assert kernel.counts.dtype == np.uint32
    assert kernel.rng_state.dtype == np.uint64
    return (
        returned,
        kernel.cycles,
        kernel.counts.tolist(),
        kernel.rng_state.tolist(),
        kernel.replica_reasons,
        kernel.replica_cycles,
    )
