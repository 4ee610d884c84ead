"""Findings of `toolchain check` about readings and lines hold on the machine, and every mistake is found."""

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.main import get_command

from machines.bm1 import Start, StopReason
from machines.parameters import PriorMode, RngKind, RngReset
from machines.reference import ReferenceBM1
from tests.toolchain.builders import boat, interval, normal, wrapped_normal
from tests.toolchain.running import OPTIONS, TINY, build_model, done, toolchain
from toolchain.building.build import assemble, build_deployment
from toolchain.building.machine import plan_machine
from toolchain.checks.check import check_deployment, check_model, source_findings, state_findings
from toolchain.checks.findings import Check, Severity, line_name, reading
from toolchain.commands.main import app
from toolchain.deployment import Scale, Source, Variable
from toolchain.models.model import Known, Model, PriorSelect, cell_centres, dimension
from toolchain.outputs.mif import mif_lines


def reading_of(name, **fields):
    """A known variable of ten cells."""
    (x,) = cell_centres(interval("x", 0, 10, cells=10))
    return normal(name, **({"mean": x, "sigma": 2.0, "values": 15, "floor": 0.05} | fields))


def model(*known, **changes):
    place = interval("x", 0, 10, cells=10)
    return Model(**{"name": "small", "searched": (place,), "known": known or (reading_of("D"),)} | changes)


def found(findings, check):
    return [finding for finding in findings if finding.check == check]


def only(findings, check):
    (finding,) = found(findings, check)
    return finding


# Findings about readings and lines, on the machine


@st.composite
def sparse_models(draw):
    """Tables with many zeros, so that lines die and readings become impossible."""
    lines = draw(st.integers(1, 5))
    known = []
    for name in ("A", "B")[: draw(st.integers(1, 2))]:
        values = draw(st.integers(1, 4))
        weights = draw(
            st.lists(st.sampled_from([0, 0, 0, 1, 4000]), min_size=values * lines, max_size=values * lines)
        )
        table = np.array(weights, float).reshape(values, lines)
        table[0, table.sum(axis=0) == 0] = 1
        missing = draw(st.sampled_from(["error", "missing"]))
        known.append(Known(name=name, table=table / table.sum(axis=0), on_missing=missing))
    prior = np.array(draw(st.lists(st.sampled_from([0, 1, 4000]), min_size=lines, max_size=lines)), float)
    if not prior.any():
        prior[0] = 1
    return Model(
        name="sparse", searched=(dimension("s", size=lines),), known=tuple(known), prior=prior / prior.sum()
    )


@settings(max_examples=60, deadline=None)
@given(sparse_models(), st.sampled_from(list(Scale)), st.data())
def test_the_machine_bears_it_out(sparse, scale, data):
    """An impossible reading ends every frame that has it; of the others some frame goes; a dead line never counts."""
    bits, boards = data.draw(st.sampled_from([1, 4])), data.draw(st.integers(1, sparse.lines))
    options = replace(OPTIONS, prob_bits=bits, scale=scale, partitions=boards)
    findings, assembled = check_model(sparse, options), assemble(plan_machine(sparse, options))
    kernels = [ReferenceBM1(image.machine) for image in assembled.images]

    def run(*addresses):
        """Counts over all boards, and whether no board had anything to count."""
        start = Start(addresses=addresses, target_count=50, max_cycles=500)
        reasons = {kernel.start(start) for kernel in kernels}
        return np.concatenate([kernel.counts for kernel in kernels]), reasons == {StopReason.IMPOSSIBLE}

    reachable = [
        [*range(known.values), *([2**known.bits - 1] if known.on_missing == "missing" else [])]
        for known in sparse.known
    ]
    frames = {addresses: run(*addresses) for addresses in itertools.product(*reachable)}
    hopeless = all(impossible for _, impossible in frames.values())
    assert any(finding.severity is Severity.ERROR for finding in findings) == hopeless
    if hopeless:
        return
    alive = assembled.quantised.prior[0] != 0
    for rows, table in zip(reachable, assembled.quantised.tables, strict=True):
        alive &= table[rows].any(axis=0)
    for place, known in enumerate(sparse.known):
        # that it leaves no line by itself is what the check says; with other readings more frames are impossible
        dead = [
            address
            for address in range(known.values)
            if not (alive & (assembled.quantised.tables[place][address] != 0)).any()
        ]
        assert all(ends for addresses, (_, ends) in frames.items() if addresses[place] in dead)
        said = [each.what for each in found(findings, Check.IMPOSSIBLE_READINGS) if each.about == known.name]
        assert sum(int(what.split(" of its ")[0].split()[-1]) for what in said) == len(dead)
    assert not any(counts[~alive].any() for counts, _ in frames.values())


def test_readings_are_named_in_the_variables_own_words():
    table = np.array([[0.0, 0.0], [0.5, 1.0], [0.0, 0.0], [0.0, 0.0], [0.5, 0.0]])
    rain = dimension("rain", size=2, states=("no", "yes"))
    known = (
        Known(name="D", table=table, offset=-2.0, step=0.5),
        Known(name="door", table=table, states=("a", "b", "c", "d", "e")),
    )
    findings = check_model(Model(name="m", searched=(rain,), known=known), OPTIONS)
    numbers, words = found(findings, Check.IMPOSSIBLE_READINGS)
    assert (numbers.severity, numbers.about) == (Severity.NOTE, "D")
    assert "3 of its 5 values (-2, -1 to -0.5)" in numbers.what
    assert "3 of its 5 values (a, c to d)" in words.what
    assert line_name((rain, dimension("x", size=3, offset=1.5)), 5) == "rain = yes, x = 3.5"
    assert reading(known[0].as_variable(), 7) == "a missing reading"


def test_a_possible_reading_without_a_code():
    table = np.array([[0.999, 0.999], [0.001, 0.001]])
    options = replace(OPTIONS, scale=Scale.COLUMN)
    finding = only(check_model(model_of(table), options), Check.IMPOSSIBLE_READINGS)
    assert finding.severity is Severity.WARNING
    assert "1 of its 2 values (1, 0.001 of all readings)" in finding.what
    assert finding.advice == "use --scale address or more --prob-bits"
    machine = assemble(plan_machine(model_of(table), options)).images[0].machine
    start = Start(addresses=(1,), target_count=255, max_cycles=100)
    assert ReferenceBM1(machine).start(start) is StopReason.IMPOSSIBLE


def model_of(table, **changes):
    lines = len(table[0])
    return Model(
        **{
            "name": "t",
            "searched": (dimension("s", size=lines),),
            "known": (Known(name="K", table=np.array(table)),),
        }
        | changes
    )


def test_lines_that_the_prior_excludes_or_loses():
    table = np.full((2, 4), 0.5)
    prior = np.array([0.0, 1e-6, 0.5, 0.5 - 1e-6])
    meant, lost = found(check_model(model_of(table, prior=prior), OPTIONS), Check.DEAD_LINES)[::-1]
    assert (meant.severity, lost.severity) == (Severity.NOTE, Severity.WARNING)
    assert "s = 0" in meant.what
    assert "s = 1" in lost.what
    written = replace(OPTIONS, prior_mode=PriorMode.WRITTEN)
    assert not found(check_model(model_of(table, prior=prior), written), Check.DEAD_LINES)
    select = PriorSelect(name="room", table=np.eye(2, 4))
    findings = check_model(model_of(table, prior_select=select), OPTIONS)
    assert only(findings, Check.DEAD_LINES).severity is Severity.NOTE
    assert "s = 2" in only(findings, Check.DEAD_LINES).what
    assert not found(findings, Check.IMPOSSIBLE_READINGS)


def test_a_column_and_a_board_without_hope():
    coarse = replace(OPTIONS, scale=Scale.NONE, prob_bits=1, partitions=2)
    spread = np.array([[0.5, 0.2]] + [[0.5, 0.2]] + [[0, 0.2]] * 3)
    findings = check_model(model_of(spread, prior=np.array([0.6, 0.4])), replace(coarse, scale=Scale.COLUMN))
    (column,) = [finding for finding in found(findings, Check.DEAD_LINES) if finding.about == "K"]
    assert "s = 1" in column.what
    assert only(findings, Check.DEAD_BOARD).about == "board 1"
    forgiving = model_of(
        spread, prior=np.array([0.6, 0.4]), known=(Known(name="K", table=spread, on_missing="missing"),)
    )  # the line counts where K is missing
    assert not found(check_model(forgiving, replace(coarse, scale=Scale.COLUMN)), Check.DEAD_LINES)
    findings = check_model(model_of(np.full((5, 2), 0.2)), coarse)
    assert only(findings, Check.DEAD_LINES).severity is Severity.ERROR


def test_a_floor_that_vanishes():
    known = reading_of("D", sigma=0.4, values=11, floor=1e-4)
    finding = only(check_model(model(known), OPTIONS), Check.VANISHED_FLOOR)
    assert (finding.severity, finding.about) == (Severity.WARNING, "D")


def test_true_lines_lost_to_the_codes():
    findings = check_model(model(), replace(OPTIONS, scale=Scale.NONE, prob_bits=5))
    assert "most often one of D (" in only(findings, Check.LOST_MASS).what


@pytest.mark.parametrize(
    ("changes", "check", "about", "numbers"),
    [
        ({"rng_banks": 1}, Check.RNG_BANKS, "rng_banks = 1", []),
        ({"rng": RngKind.IDEAL}, Check.RNG, "rng = ideal", []),
        ({"steps_per_clock": 1}, Check.RNG_STEPS, "steps_per_clock = 1", [8, 7]),
        ({"rng": RngKind.LFSR16}, Check.RNG_PERIOD, "rng = lfsr16", [65535, 131072]),
        (
            {"rng": RngKind.LFSR16, "steps_per_clock": 15},
            Check.RNG_PERIOD,
            "rng = lfsr16",
            [4369, 65535, 15, 131072],
        ),
        ({"rng": RngKind.TABLE}, Check.RNG_PERIOD, "rng = table", [65536, 131072]),
        ({"target_count": 200, "max_cycles": 199}, Check.STOPPING, "the machine", [200, 199]),
    ],
)
def test_generators_and_stopping(changes, check, about, numbers):
    finding = only(check_model(model(), replace(OPTIONS, **changes)), check)
    assert finding.about == about
    assert [int(each) for each in re.findall(r"\b\d+\b(?!\.)", finding.what)][: len(numbers)] == numbers
    assert finding.severity is (Severity.NOTE if check is Check.RNG else Severity.WARNING)


def test_what_ends_a_warning_about_generators():
    free = replace(OPTIONS, rng_banks=1, rng_reset=RngReset.FREE)
    short = replace(OPTIONS, rng=RngKind.LFSR16, max_cycles=65535)
    for options in (OPTIONS, free, short, replace(OPTIONS, target_count=200, max_cycles=200)):
        assert check_model(model(), options) == []


def test_related_columns_name_the_bits():
    """An LFSR of 8 bits has 255 states: with so few, three columns' bits are bound to be related."""
    known = tuple(Known(name=f"K{i}", table=np.array([[0.9, 0.1], [0.1, 0.9]])) for i in range(6))
    options = replace(OPTIONS, rng=RngKind.LFSR8, prob_bits=7, max_cycles=255)
    one, *_ = found(check_model(model_of(known[0].table, known=known), options), Check.RNG_RELATION)
    assert one.severity is Severity.ERROR
    assert "3 random bits of several columns XOR to 0 in every cycle" in one.what
    cells = replace(options, shared=False, rng_banks=3)
    related = found(check_model(model_of(known[0].table, known=known), cells), Check.RNG_RELATION)
    assert "of 6 lines in a bank" in related[0].what
    options = replace(OPTIONS, rng=RngKind.LFSR8, prob_bits=7, rng_banks=2)
    said = [
        each.what for each in found(check_model(model(*map(reading_of, "ABCD")), options), Check.RNG_RELATION)
    ]
    for what in said:
        names = re.findall(r"bit \d of (the prior|\w)", what)
        assert ("of different columns" in what) == (len(set(names)) == len(names)), what
    assert said


@pytest.mark.parametrize(
    ("table", "check", "severity", "part"),
    [
        (np.arange(512) // 2 * 2, Check.RNG_TABLE, Severity.WARNING, "code 1 "),
        (np.arange(4096) % 256, Check.RNG_RELATION, Severity.WARNING, "table of 4096"),
        (np.full(100, 7), Check.RNG_TABLE, Severity.WARNING, "0.03125"),
        (np.array([3]), Check.RNG_RELATION, Severity.ERROR, "(index 0, group 0)"),
    ],
)
def test_tables_of_random_numbers(table, check, severity, part):
    options = replace(OPTIONS, rng=RngKind.TABLE, rng_table=table.astype(np.uint32), max_cycles=10)
    findings = found(check_model(model(), options), check)
    assert any(finding.severity is severity and part in finding.what for finding in findings), findings


@pytest.mark.parametrize("bits", [1, 2, 16])
def test_codes_of_any_width(bits):
    options = replace(OPTIONS, rng=RngKind.TABLE, prob_bits=bits, max_cycles=10)
    assert not [finding for finding in check_model(model(), options) if finding.check.startswith("rng")]


@pytest.mark.parametrize(
    ("changes", "check", "numbers", "advice"),
    [
        ({"bits": 6}, Check.ADDRESS_BITS, ["10", "4", "6", "4"], "--bits B=4"),
        ({"period": 12}, Check.RANGE, ["12", "10", "10"], "12 values"),
        ({"period": 8}, Check.RANGE, ["8", "2", "10"], "a period of 10"),
        ({"on_range": "missing"}, Check.RANGE, [], 'on_missing="missing"'),
    ],
)
def test_ranges(changes, check, numbers, advice):
    known = wrapped_normal("B", mean=np.arange(4.0), sigma=1.0, values=10, step=1.0, floor=0.05)
    searched = (dimension("s", size=4),)
    findings = check_model(model(replace(known, **changes), searched=searched), OPTIONS)
    finding = only(findings, check)
    assert finding.about == "B"
    assert re.findall(r"\d+", finding.what) == numbers
    assert advice in finding.advice


def test_columns_without_effect_and_readings_used_twice():
    table = np.full((2, 3), 0.5)
    known = tuple(Known(name=name, table=table, path="data[0]") for name in "AB")
    findings = check_model(model_of(table, known=known), OPTIONS)
    assert [finding.about for finding in found(findings, Check.COLUMN_WITHOUT_EFFECT)] == ["A", "B"]
    assert only(findings, Check.SAME_READING).about == "A and B"
    bare = [reading_of(name, path=path) for name, path in (("D", ""), ("E", "D"), ("F", "F"))]
    finding = only(check_model(model(*bare), OPTIONS), Check.SAME_READING)
    assert finding.about == "D and E"
    assert finding.what.split()[-1] == "D"


def test_several_mistakes_at_once():
    options = replace(OPTIONS, partitions=11, prob_bits=17)
    findings = check_model(model(), options)
    assert [(finding.severity, finding.about) for finding in findings] == [
        (Severity.ERROR, "the partitions"),
        (Severity.ERROR, "the machine"),
    ]


# Deployments


@pytest.fixture
def deployment(tmp_path):
    build_model(model(), tmp_path / "out", partitions=2)
    return tmp_path / "out"


def test_a_deployment_contains_the_values_of_its_model(tmp_path):
    table = np.array([[0.0, 0.0, 0.0], [0.999, 0.5, 1.0], [0.001, 0.5, 0.0]])
    options = replace(OPTIONS, scale=Scale.COLUMN, rng=RngKind.LFSR16, partitions=2, rng_banks=1)
    one = model_of(table, prior=np.array([0.0, 0.5, 0.5]))
    build_deployment(plan_machine(one, options), tmp_path / "out")
    said = {(finding.check, finding.about) for finding in check_model(one, options)}
    assert {(finding.check, finding.about) for finding in check_deployment(tmp_path / "out")} == said
    assert (Check.IMPOSSIBLE_READINGS, "K") in said
    assert (Check.DEAD_LINES, "the prior") in said


def test_files_of_a_deployment(deployment):
    assert check_deployment(deployment) == []
    (deployment / "bm_arch/Memory_MIFs/board0_prior.mif").write_text("".join(mif_lines(40, 1, [1])))
    (deployment / "bm1.tcl").unlink()
    memories, project = check_deployment(deployment)
    assert (memories.check, memories.about) == (Check.FILES, "bm_arch/Memory_MIFs/board0_prior.mif")
    assert memories.advice.endswith(f"use 'toolchain regenerate memories {deployment}'")
    assert project.about == "bm1.tcl"
    image = deployment / "boards/board0.bm"
    image.write_bytes(image.read_bytes()[:-1])
    (finding,) = check_deployment(deployment)
    assert finding.severity is Severity.ERROR
    assert "board0.bm" in finding.what


def test_comments_are_not_contents(deployment):
    path = deployment / "bm_arch/bm1_parameters.vhd"
    path.write_text(path.read_text().replace("-- Parameters", "-- My parameters") + "\n-- seen\n")
    assert check_deployment(deployment) == []
    path.write_text(path.read_text().replace("LINES             : positive := 10", "LINES : positive := 11"))
    assert len(check_deployment(deployment)) == 1


MODEL = TINY


def test_a_check_takes_what_a_build_takes(case):
    build, check = (
        {flag for each in get_command(app).commands[name].params for flag in each.opts}
        for name in ("build", "check")
    )
    assert build - {"model"} <= check
    sources = case.parent / "sources.toml"
    sources.write_text(
        '[[source]]\ntopic = "/a"\ntype = "std_msgs/Float64"\nvariables = { K = "data" }\n'
        '[[source]]\ntopic = "/b"\ntype = "std_msgs/Float64"\nprior = "data"\nvariables = {}\n'
    )
    options = ("--sources", sources, "--uri", "ws://a:1", "--tolerance", "0.001", "--prior-mode", "written")
    result = toolchain("check", case, "-o", case.parent / "out", *options)
    assert "warning: /a and /b: " in done(result).stdout
    assert not (case.parent / "out").exists()
    refused = toolchain("check", case, "--topic", "no topic")
    assert (refused.exit_code, "topic" in refused.stdout) == (2, True)


@pytest.mark.parametrize(
    ("states", "numbers", "severity"),
    [
        (("low", "mid", "high"), {}, None),
        (("0", "5", "20"), {}, Severity.WARNING),
        (("1", "2", "many"), {}, Severity.WARNING),
        (("10", "20", "30"), {}, Severity.WARNING),
        (("10", "20", "30"), {"offset": 10.0, "step": 10.0}, None),
        (("0", "1"), {}, None),
        (("wet", "dry"), {}, Severity.NOTE),
        (("no", "yes"), {}, None),
        (("Yes", "No"), {}, Severity.WARNING),
        (("yes", "no"), {"offset": 1.0, "step": -1.0}, None),
    ],
)
def test_states_that_a_number_or_a_bool_could_mistake(states, numbers, severity):
    variable = Variable(name="S", bits=3, values=len(states), states=states, **numbers)
    found_ones = list(state_findings(variable))
    assert [(each.check, each.severity) for each in found_ones] == (
        [(Check.STATES, severity)] if severity else []
    )


def test_the_command_as_words_or_json(case):
    result = toolchain("check", case)
    assert (result.exit_code, result.stdout[:9]) == (0, "note: K: ")
    assert result.stderr == f"{case}: 0 errors, 0 warnings, 1 note\n"
    result = toolchain("check", case, "--set", "bits=1")
    assert result.exit_code == 2
    assert "line 7: variable 'K'" in result.stdout
    unbuildable = ("--counter-bits", 4, "--target-count", 300)
    result = toolchain("check", case, "--json", "--rng-banks", 1, *unbuildable, "--bits", "K=4")
    assert (result.exit_code, result.stderr) == (2, "")
    finding = json.loads(result.stdout)
    assert list(finding) == ["severity", "check", "about", "what", "advice"]
    assert list(finding.values())[:3] == ["error", "cannot-be-built", "the machine"]


def test_a_deployment_is_checked_although_an_installed_model_has_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert toolchain("check", "boat", "--partitions", "4").exit_code == 0
    build_model(model(), tmp_path / "boat")
    refused = toolchain("check", "boat", "--partitions", "4")
    assert (refused.exit_code, "boat is a deployment" in refused.stderr) == (2, True)


def test_json_stays_json_when_a_model_prints(case):
    file = case / "model.py"
    text = file.read_text().replace("):\n    return", "):\n    print('a call')\n    return")
    file.write_text("print('an import')\n" + text)
    result = toolchain("check", case, "--json")
    assert [json.loads(line)["about"] for line in result.stdout.splitlines()] == ["K"]
    assert result.stderr == "an import\na call\n"


def deployment_of(*types, tolerance_s):
    return boat(
        sources=tuple(Source(uri="ws://a:1", topic=f"/t{at}", type=each) for at, each in enumerate(types)),
        variables=tuple(Variable(name=f"D{at}", source=at, bits=7, values=101) for at in range(len(types))),
        tolerance_s=tolerance_s,
    )


@pytest.mark.parametrize(
    ("types", "tolerance_s", "severity"),
    [
        (["std_msgs/msg/Float64"], 0.0, None),
        (["sensor_msgs/Imu", "sensor_msgs/LaserScan"], 0.0, None),
        (["std_msgs/msg/Float64", "sensor_msgs/msg/Imu"], 0.05, Severity.NOTE),
        (["geometry_msgs/Twist", "sensor_msgs/Imu"], 0.05, Severity.NOTE),
        (["geometry_msgs/TwistStamped", "sensor_msgs/Imu"], 0.05, None),
        (["std_msgs/Float64", "std_msgs/Float64"], 0.05, None),
        (["std_msgs/Float64", "std_msgs/Float64"], 0.001, Severity.WARNING),
    ],
)
def test_topics_that_pair_by_receipt(types, tolerance_s, severity):
    findings = list(source_findings(deployment_of(*types, tolerance_s=tolerance_s)))
    assert [(each.check, each.severity) for each in findings] == (
        [(Check.PAIRING, severity)] if severity else []
    )
