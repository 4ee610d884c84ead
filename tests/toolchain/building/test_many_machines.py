"""Replicas, and readings for each line: arrays become addresses by the same rule, and builds match their options."""

import base64
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines import make_kernel
from machines.bm1 import Start
from machines.encode import decode_code
from machines.parameters import RngKind, SensorMode
from pcie_shim.programming_file import read_image
from tests.toolchain.running import OPTIONS, TARGET, TINY, assert_refused, done, toolchain
from toolchain.analysis.accuracy import measure
from toolchain.analysis.emulation import EmulatedBoards, one_replica
from toolchain.analysis.logic import DEVICES, logic_of
from toolchain.analysis.readings import readings_of_lines, sample_readings
from toolchain.analysis.resources import estimate
from toolchain.building.build import BuildError, assemble, build_deployment
from toolchain.building.machine import plan_machine
from toolchain.checks.check import check_deployment
from toolchain.deployment import REPLICA, Scale, Stop, load_deployment
from toolchain.deployment.address import to_address
from toolchain.deployment.address_array import MISSING, to_addresses, written_prior
from toolchain.errors import NotANumberError, ReadingError, ReadingMissingError, ValueOutOfRangeError
from toolchain.models.model import Known, Model, PriorSelect, dimension, exact_posterior

CELL = replace(OPTIONS, sensor_mode=SensorMode.CELL)
THRESHOLD = replace(OPTIONS, sensor_mode=SensorMode.THRESHOLD)


def model(lines=6, *, select=False, **known):
    random = np.random.default_rng(2)
    tables = [random.dirichlet(np.full(5, 0.8), lines).T for _ in range(2)]
    return Model(
        name="disparity",
        searched=(dimension("disparity", size=lines),),
        known=(Known(name="left", table=tables[0], **known), Known(name="right", table=tables[1])),
        prior_select=PriorSelect(name="light", table=random.dirichlet(np.ones(lines), 2)) if select else None,
    )


def deployment_of(options, **changes):
    return assemble(plan_machine(model(**changes), options)).deployment


# Arrays to addresses


def variable_of(deployment, **changes):
    return deployment.variables[0].model_copy(update=changes)


@given(
    st.lists(st.floats(-4, 9) | st.integers(-4, 9), min_size=6, max_size=6),
    st.sampled_from(["clamp", "missing", "error"]),
    st.sampled_from([None, 5]),
)
def test_every_number_becomes_what_it_becomes_alone(numbers, on_range, period):
    deployment = deployment_of(replace(OPTIONS, replicas=6))
    variable = variable_of(
        deployment, offset=0.5, step=0.75, on_range=on_range, on_missing="missing", period=period
    )
    try:
        alone = [to_address(variable, number) for number in numbers]
    except ValueOutOfRangeError:
        with pytest.raises(ValueOutOfRangeError, match=r"value \d of the array"):
            to_addresses(deployment, variable, numbers)
        return
    expected = [MISSING if address is None else address for address in alone]
    assert to_addresses(deployment, variable, numbers) == (None if set(expected) == {MISSING} else expected)


@pytest.mark.parametrize(
    "given_as",
    [
        lambda numbers: numbers,
        tuple,
        lambda numbers: [numbers[:6], numbers[6:]],
        lambda numbers: np.array(numbers, np.uint8),
        lambda numbers: np.array(numbers, np.float32).reshape(2, 6),
        bytes,
        lambda numbers: base64.b64encode(bytes(numbers)).decode(),
    ],
)
def test_an_array_may_come_in_every_form(given_as):
    deployment = deployment_of(replace(CELL, replicas=2))
    numbers = [0, 1, 2, 3, 4, 0, 4, 3, 2, 1, 0, 2]
    assert to_addresses(deployment, deployment.variables[0], given_as(numbers)) == numbers


def test_a_reading_is_missing_on_all_lines_or_on_none():
    deployment = deployment_of(replace(CELL, replicas=2))
    variable = variable_of(deployment, on_missing="missing")
    none = [None] * 6
    assert to_addresses(deployment, variable, [*none, *range(5), 0]) == [MISSING] * 6 + [0, 1, 2, 3, 4, 0]
    assert to_addresses(deployment, variable, [math.nan] * 12) is None
    assert to_addresses(deployment, variable, None) is None
    assert to_addresses(deployment, variable, []) is None
    with pytest.raises(ReadingMissingError, match="replica 1"):
        to_addresses(deployment, variable, [*none, None, 0, 1, 2, 3, 4])
    with pytest.raises(ReadingMissingError):
        to_addresses(deployment, deployment.variables[0], [*none, *range(5), 0])
    with pytest.raises(ReadingMissingError):
        to_addresses(deployment, deployment.variables[0], None)
    replicas = deployment_of(replace(OPTIONS, replicas=3), on_missing="missing", states=tuple("abcde"))
    assert to_addresses(replicas, replicas.variables[0], [1, None, 2]) == [1, MISSING, 2]
    assert to_addresses(replicas, replicas.variables[0], ["b", "e", "a"]) == [1, 4, 0]
    with pytest.raises(NotANumberError, match="an array with strings"):
        to_addresses(replicas, replicas.variables[0], ["b", "f", "a"])


@pytest.mark.parametrize(
    ("options", "value", "error"),
    [
        (CELL, [1, 2], ReadingError),
        (CELL, 7, NotANumberError),
        (CELL, "no base 64", NotANumberError),
        (CELL, [["1"] * 6] * 2, NotANumberError),
        (CELL, [[1, 2], [3]], NotANumberError),
        (CELL, [0] * 11 + [5], ValueOutOfRangeError),
        (CELL, [0] * 11 + [math.inf], ValueOutOfRangeError),
        (THRESHOLD, [0] * 12, ReadingError),
        (THRESHOLD, [0.1] * 11 + [-0.1], ReadingError),
        (THRESHOLD, [0.1] * 11 + [math.inf], ReadingError),
        (replace(THRESHOLD, scale=Scale.NONE), [0.1] * 11 + [1.5], ReadingError),
    ],
)
def test_another_array_is_refused(options, value, error):
    deployment = deployment_of(replace(options, replicas=2))
    with pytest.raises(error):
        to_addresses(deployment, deployment.variables[0], value)


@pytest.mark.parametrize("number", [None, math.nan])
def test_a_likelihood_is_missing_on_all_lines_or_on_none(number):
    deployment = deployment_of(replace(THRESHOLD, replicas=2), on_missing="missing")
    variable = deployment.variables[0]
    codes = to_addresses(deployment, variable, [number] * 6 + [0.5] * 6)
    assert codes == [MISSING] * 6 + [255] * 6
    assert to_addresses(deployment, variable, [number] * 12) is None
    # a likelihood of 0 would make this line impossible
    with pytest.raises(ReadingMissingError, match="replica 1"):
        to_addresses(deployment, variable, [0.5] * 11 + [number])
    needed = variable_of(deployment, on_missing="error")
    with pytest.raises(ReadingMissingError):
        to_addresses(deployment, needed, [number] * 6 + [0.5] * 6)


@pytest.mark.parametrize("scale", [Scale.COLUMN, Scale.NONE])
def test_likelihoods_become_codes(scale):
    deployment = deployment_of(replace(THRESHOLD, scale=scale))
    likelihoods = [0.5, 0.25, 0.0, 0.1, 0.05, 0.5]
    codes = to_addresses(deployment, deployment.variables[0], likelihoods)
    largest = max(likelihoods) if scale is Scale.COLUMN else 1
    assert decode_code(codes, 8) == pytest.approx(np.array(likelihoods) / largest, abs=2**-8)


def test_written_priors_of_replicas():
    one = written_prior([1, 2, 4], lines=3, prob_bits=8)
    assert written_prior([1, 2, 4], lines=3, prob_bits=8, replicas=2).tolist() == [one.tolist()] * 2
    both = written_prior([1, 2, 4, 3, 3, 0], lines=3, prob_bits=8, replicas=2)
    assert both.tolist() == [one.tolist(), [255, 255, 0]]
    for wrong in ([1, 2], [1, 2, 4, 0, 0, 0]):
        with pytest.raises(ReadingError):
            written_prior(wrong, lines=3, prob_bits=8, replicas=2)


@pytest.mark.parametrize(
    "options",
    [
        replace(OPTIONS, replicas=3),
        replace(CELL, partitions=2),
        replace(CELL, replicas=3, partitions=2),
        replace(THRESHOLD, replicas=2, prob_bits=6),
        replace(CELL, rng=RngKind.TABLE, shared=False, rng_banks=2, max_cycles=60000),
    ],
)
def test_a_build_of_each_kind(tmp_path, options):
    built = build_deployment(plan_machine(model(select=True), options), tmp_path)
    deployment = load_deployment(tmp_path)
    assert deployment == built.deployment
    text = (tmp_path / "deployment.toml").read_text()
    assert ("replicas = " in text) == (options.replicas > 1)
    assert ("sensor_mode = " in text) == (options.sensor_mode is not SensorMode.COLUMN)
    for at, image in enumerate(read_image(deployment.image_path(i)) for i in range(options.partitions)):
        parameters = image.machine.parameters
        assert (parameters.replicas, parameters.sensor_mode) == (options.replicas, options.sensor_mode)
        tables = sorted(tmp_path.glob(f"bm_arch/Memory_MIFs/board{at}_column*.mif"))
        assert len(tables) == (2 if parameters.has_tables else 0)
    package = (tmp_path / "bm_arch/bm1_parameters.vhd").read_text()
    assert re.search(rf"constant REPLICAS +: positive := {options.replicas};", package)
    assert f"SENSOR_{options.sensor_mode.upper()};" in package
    findings = check_deployment(tmp_path)
    assert [finding for finding in findings if finding.severity.name != "NOTE"] == []


CALLED_REPLICA = replace(model(), searched=(dimension(REPLICA, size=6),))


@pytest.mark.parametrize(
    ("of", "options", "mended", "advice"),
    [
        (model(), replace(CELL, scale=Scale.ADDRESS), {"scale": Scale.COLUMN}, "--scale"),
        (model(), replace(THRESHOLD, scale=Scale.ADDRESS), {"scale": Scale.COLUMN}, "--scale"),
        (model(), replace(CELL, replicas=3, interface=(35, 18)), {"interface": (36, 18)}, "36x18"),
        (model(), replace(OPTIONS, replicas=3, interface=(9000, 18)), {"interface": (9, 18)}, "9000x18"),
        (
            model(40),
            replace(CELL, replicas=200),
            {"partitions": 2},
            "2 or more, or --replicas [0-9]+ or fewer",
        ),
        (CALLED_REPLICA, replace(OPTIONS, replicas=2), {"replicas": 1}, "'replica'"),
    ],
)
def test_options_that_do_not_fit_have_a_way_out(of, options, mended, advice):
    with pytest.raises(BuildError, match=advice):
        assemble(plan_machine(of, options))
    assemble(plan_machine(of, replace(options, **mended)))


# Estimates and errors before a build


@pytest.mark.parametrize(
    "options", [replace(CELL, replicas=3, partitions=2), replace(THRESHOLD, partitions=2)]
)
def test_drawn_readings_give_the_models_posterior(options):
    of = model()
    built = assemble(plan_machine(of, replace(options, prob_bits=12, counter_bits=16)))
    machines = [one_replica(image.machine) for image in built.images]
    drawn = sample_readings(of, 12, seed=4)
    readings = readings_of_lines(drawn, of, machines[0], scale=Scale.COLUMN, seed=4)
    boards = EmulatedBoards(machines, target_count=60000, max_cycles=2**22, stop=Stop.SLICES)
    for frame in range(12):
        addresses, row = readings.of_model(frame)
        exact = exact_posterior(of, addresses, prior_address=row)
        found = boards.run(*readings.of_machine(frame, machines[0]), bank=frame)
        assert found.posterior == pytest.approx(exact, abs=0.015)
    assert np.array_equal(readings.addresses[np.arange(12), :, drawn.lines], drawn.addresses)


def test_replicas_share_the_generators_and_multiply_the_rest():
    def parts(parameters):
        return {part.name: part for part in logic_of(parameters).parts}

    one = assemble(plan_machine(model(), CELL)).images[0].machine.parameters
    ten, per_column = replace(one, replicas=10), replace(one, sensor_mode=SensorMode.COLUMN)
    alone, together = parts(one), parts(ten)
    assert together["generators"] == alone["generators"]
    assert together["cells"].alms == pytest.approx(10 * alone["cells"].alms)
    assert together["counters"].registers == 10 * alone["counters"].registers
    assert together["control"].registers > alone["control"].registers
    assert alone["inputs"].aluts > parts(per_column)["inputs"].aluts
    codes = replace(one, sensor_mode=SensorMode.THRESHOLD, sensor_bits=(8, 8))
    bits = [estimate(each, DEVICES["proce-v-d8"]).memories.table_bits for each in (one, ten, codes)]
    assert bits == [bits[0], 10 * bits[0], 0]


@pytest.mark.parametrize("mode", list(SensorMode))
def test_a_frame_of_replicas_is_measured_as_a_board_runs_it(mode):
    of = model()
    built = assemble(plan_machine(of, replace(OPTIONS, sensor_mode=mode, replicas=3)))
    (machine,) = [image.machine for image in built.images]
    alone = one_replica(machine)
    readings = sample_readings(of, 12, seed=5)
    if mode is not SensorMode.COLUMN:
        readings = readings_of_lines(readings, of, alone, scale=Scale.COLUMN, seed=5)
    boards = EmulatedBoards([alone], target_count=255, max_cycles=5000, stop=Stop.OWN)
    measured = measure(boards, readings, of, banks=1, replicas=3)
    assert (measured.frames, measured.posteriors) == (4, 12)
    kernel, lengths = make_kernel(machine), []
    for frame in range(4):
        ones = [readings.of_machine(3 * frame + replica, alone)[0] for replica in range(3)]
        kernel.start(Start(addresses=np.array(ones), target_count=255, max_cycles=5000, bank=frame))
        lengths.append(kernel.cycles)
    assert measured.cycles.worst == max(lengths)
    assert measured.cycles.median.value == np.median(lengths)
    with pytest.raises(BuildError, match="20 replicas.* 12 "):
        measure(boards, readings, of, replicas=20)


def test_boards_are_filled_with_machines(case):
    """As many as fit on a board, and lines are divided only if one machine does not fit."""
    (case / "model.py").write_text(TINY.replace("size: int = 4", "size: int = 100"))
    out = case.parent / "out"
    fill = ("build", case, "-o", out, *TARGET, "--replicas", "fill")
    assert_refused(toolchain(*fill), "--replicas fill", "--device")
    report = done(toolchain(*fill, "--device", "proce-v-d8")).stdout
    assert "40 machines fill a board" in report
    assert "with 41, the machine takes 4,100 result registers, but the map has only 4,096." in report
    deployment = load_deployment(out)
    assert (deployment.machine.replicas, len(deployment.boards)) == (40, 1)
    done(toolchain(*fill, "--device", "proce-v-d8", "--set", "size=5000"))
    deployment = load_deployment(out)
    assert (deployment.machine.replicas, len(deployment.boards)) == (1, 2)
    report = done(toolchain(*fill, "--device", "proce-v-d8", "--interface", "20x1200")).stdout
    assert "12 machines fill a board" in report
    assert "with 13, the machine takes 1,300 result registers, but the interface has only 1,200." in report
    over = ("build", case, "-o", out, *TARGET, "--replicas", "50")
    assert_refused(toolchain(*over), "--partitions 2 or more", "--replicas 40 or fewer")
    assert_refused(
        toolchain("build", case, "-o", out, *TARGET, "--replicas", "0"), "--replicas", "256", "fill"
    )
