"""A BM2 built from a network: its tables, images and files, the choice of the machine, and what is refused.

network, flags ──▶ plan_bm2 ──▶ BM2Plan ──▶ one image per chain, MIFs, deployment.toml ──▶ posterior
                   └─▶ MachinePlan of a BM1 if the question is a naive fusion
"""

import contextlib
import shlex
from dataclasses import replace

import numpy as np
import pytest

from machines.bm2 import BM2Parameters, unpack
from machines.parameters import RngKind, Sequencer
from machines.rng import LFSR, random_numbers
from posteriors import posterior
from tests.machines.bm2_of_the_page import PageBM2
from tests.toolchain.running import OPTIONS, TARGET, TINY, assert_refused, contents, done, toolchain
from toolchain.building.bm2_machine import BM2Plan, chain_machines, plan_bm2
from toolchain.building.build import assemble, check_agreement, read_images
from toolchain.building.choice import model_for
from toolchain.building.options import BM1Options, BM2Options, MachineChoice, given_flags
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError, DeploymentError
from toolchain.models import IntegerType, JointDistribution, Symbol, potential, table, uniform
from toolchain.networks import read_network
from toolchain.outputs.mif import read_mif

MODEL = TINY

ASIA = """
variable asia { type discrete [ 2 ] { yes, no }; }
variable tub { type discrete [ 2 ] { yes, no }; }
variable smoke { type discrete [ 2 ] { yes, no }; }
variable lung { type discrete [ 2 ] { yes, no }; }
variable bronc { type discrete [ 2 ] { yes, no }; }
variable either { type discrete [ 2 ] { yes, no }; }
variable xray { type discrete [ 2 ] { yes, no }; }
variable dysp { type discrete [ 2 ] { yes, no }; }
probability ( asia ) { table 0.01, 0.99; }
probability ( tub | asia ) { (yes) 0.05, 0.95; (no) 0.01, 0.99; }
probability ( smoke ) { table 0.5, 0.5; }
probability ( lung | smoke ) { (yes) 0.1, 0.9; (no) 0.01, 0.99; }
probability ( bronc | smoke ) { (yes) 0.6, 0.4; (no) 0.3, 0.7; }
probability ( either | lung, tub ) { (yes, yes) 1.0, 0.0; (no, yes) 1.0, 0.0; (yes, no) 1.0, 0.0; (no, no) 0.0, 1.0; }
probability ( xray | either ) { (yes) 0.98, 0.02; (no) 0.05, 0.95; }
probability ( dysp | bronc, either ) {
  (yes, yes) 0.9, 0.1; (no, yes) 0.7, 0.3; (yes, no) 0.8, 0.2; (no, no) 0.1, 0.9;
}
"""
GRASS = ("--searched", "rain", "--known", "sprinkler,grass")  # grass depends on the sprinkler


@pytest.fixture
def asia(tmp_path):
    path = tmp_path / "asia.bif"
    path.write_text(ASIA)
    return path


def build(path, *arguments, name="out"):
    return toolchain("build", path, "-o", path.parent / name, *TARGET, *arguments)


def codes_of_the_page(term, sizes, prob_bits):
    """Compute a CDE's table, code by code, with the machine that is written from its description."""
    cardinalities = tuple(sizes[name] for name in term.scope)
    parameters = BM2Parameters(
        cardinalities=cardinalities, factors=(tuple(range(len(cardinalities))),), prob_bits=prob_bits
    )
    page, codes = PageBM2(parameters, [term.table], None), []
    for pointed in page.names:
        others = [name for name in page.names if name != pointed]
        for state in range(2 ** len(others)):
            page.bits = {pointed: 0} | {name: state >> at & 1 for at, name in enumerate(others)}
            codes.append(page.code(0, pointed))
    return codes


def test_a_network_becomes_chains_with_the_tables_of_its_factors(network):
    arguments = (*GRASS, *shlex.split("--partitions 3 --prob-bits 12 --samples 70 --sequencer coloured"))
    result = done(build(network, *arguments, "--burn-in", "5", "--stream", "9", "--on-missing", "missing"))
    out = network.parent / "out"
    assert "Building a BM2, since sprinkler and grass are not independent given rain" in result.stderr
    assert result.stdout == (out / "report.txt").read_text()
    deployment = load_deployment(out)
    machine = deployment.machine
    assert (machine.type, machine.lines, machine.target_count, machine.max_cycles) == ("BM2", 2, 70, 2**28)
    assert (machine.sequencer, machine.burn_in, machine.stream) == (Sequencer.COLOURED, 5, 9)
    assert machine.variables == ("rain", "sprinkler", "grass")  # nobody asks for the shoes
    assert [board.line_offset for board in deployment.boards] == [0, 1, 2]
    assert [variable.on_missing for variable in deployment.variables] == ["missing"] * 2
    images = read_images(deployment)
    parameters = [image.machine.parameters for image in images]
    assert [(each.chain, each.chains, each.known) for each in parameters] == [
        (at, 3, (1, 2)) for at in range(3)
    ]
    assert len({image.image_hash for image in images}) == 3
    question = read_network(network).ask(["rain"], ["sprinkler", "grass"]).network()
    sizes = dict(zip(question.names, question.cardinalities, strict=True))
    for at, term in enumerate(question.factors):
        expected = codes_of_the_page(term, sizes, 12)
        assert images[2].machine.tables[at].tolist() == expected
        mif = read_mif(out / f"bm_arch/Memory_MIFs/cde{at}.mif")
        assert (mif.width, list(mif.words)) == (12, expected)
        assert f"  {question.titles[at]} " in result.stdout


def test_seeds_are_those_of_each_board_and_bank(network):
    done(build(network, *GRASS, "--partitions", "2", "--rng-banks", "3"))
    out = network.parent / "out"
    for board, image in enumerate(read_images(load_deployment(out))):
        numbers = random_numbers(image.machine)
        mif = read_mif(out / f"bm_arch/Memory_MIFs/board{board}_rng_seeds.mif")
        assert list(mif.words) == [int(each) for bank in range(3) for each in numbers.restart(bank)]
        sequencer = read_mif(out / f"bm_arch/Memory_MIFs/board{board}_sequencer_seeds.mif")
        sets = np.array([bank * 2 + board for bank in range(3)], dtype=np.uint64)
        assert list(sequencer.words) == LFSR(RngKind.LFSR16).seeds(sets).tolist()


def test_codes_of_values_that_are_no_power_of_two():
    a, b = Symbol("A", IntegerType(0, 2)), Symbol("B", IntegerType(0, 4))
    rng = np.random.default_rng(3)
    factors = (potential([a, b], rng.random((3, 5)) * (rng.random((3, 5)) > 0.3)), uniform(a))
    model = JointDistribution("n", factors).ask(["A"], ["B"]).network()
    (machine,) = chain_machines(plan_bm2(model, OPTIONS))
    sizes = {"A": 3, "B": 5}
    for term, codes in zip(model.factors, machine.tables, strict=True):
        assert codes.tolist() == codes_of_the_page(term, sizes, 16)


def test_the_hash_of_a_model_covers_what_is_possible():
    """A probability that is too small for a code, and 0, have the same codes."""
    a, b = (Symbol(name, IntegerType(0, 1)) for name in "AB")
    images = []
    for least in (0, 1e-9):
        factors = (uniform(a), potential([a, b], np.array([[1, 1], [1, least]])))
        network = JointDistribution("n", factors).ask(["A"], ["B"]).network()
        images.append(assemble(plan_bm2(network, OPTIONS)).images[0])
    one, other = images
    for own, its in zip(one.machine.tables, other.machine.tables, strict=True):
        assert own.tolist() == its.tolist()
    assert one.model_hash != other.model_hash


def test_the_hash_of_a_model_covers_the_scopes_of_its_factors():
    a, b, c = (Symbol(name, IntegerType(0, 1)) for name in "ABC")
    images = []
    for other in (a, b):
        factors = [potential(scope, np.array([[1, 2], [3, 1]])) for scope in ([a, b], [other, c])]
        network = JointDistribution("n", tuple(factors)).ask(["A"], ["B", "C"]).network()
        images.append(assemble(plan_bm2(network, OPTIONS)).images[0])
    tables = [[each.tolist() for each in image.machine.tables] for image in images]
    assert tables[0] == tables[1]
    assert images[0].model_hash != images[1].model_hash


def test_a_frame_has_64_cycles_for_each_move_unless_others_are_asked_for():
    a, b = (Symbol(name, IntegerType(0, 1)) for name in "AB")
    network = JointDistribution("n", (potential([a, b], np.ones((2, 2))),)).ask(["A"], ["B"]).network()
    many = replace(OPTIONS, target_count=10**7, burn_in=5)
    assert plan_bm2(network, many).max_cycles == 64 * (5 + 10**7) * 2
    assert plan_bm2(network, replace(many, max_cycles=5)).max_cycles == 5


def test_the_same_network_gives_the_same_bytes(asia):
    arguments = ("--searched", "bronc", "--known", "smoke,dysp", "--partitions", "2", "--rng", "table")
    for name in ("one", "two"):
        done(build(asia, *arguments, name=name))
    files = contents(asia.parent / "one")
    assert files == contents(asia.parent / "two")
    assert "bm_arch/Memory_MIFs/rng_table.mif" in files
    assert not [name for name in files if name.endswith((".vhd", ".qpf", ".qsf", ".tcl"))]
    # a machine of the other kind replaces all of it
    done(build(asia, "--searched", "smoke,either", "--known", "bronc", name="two"))
    assert not [name for name in contents(asia.parent / "two") if "cde" in name]
    done(build(asia, *arguments, name="two"))
    assert contents(asia.parent / "two") == files


def test_the_posterior_of_a_deployment_is_that_of_the_network(network):
    done(build(network, "--searched", "rain", "--known", "grass", "--machine", "bm2", "--samples", "400000"))
    found = posterior(network.parent / "out", {"grass": "wet"})
    assert found.probabilities[0] == pytest.approx(0.3577, abs=0.03)


def test_the_start_of_a_chain_follows_from_the_images(asia):
    done(build(asia, "--searched", "bronc", "--known", "smoke,dysp", "--given", "asia=yes"))
    (image,) = read_images(load_deployment(asia.parent / "out"))
    parameters = image.machine.parameters
    assert len(parameters.cardinalities) == 6  # without asia, which is given, and the X-ray
    assert unpack(parameters, 0b111111) == (1,) * 6


# The choice of the machine


def test_a_naive_fusion_becomes_a_bm1_unless_a_bm2_is_asked_for(network, case):
    fusion = ("--searched", "rain,sprinkler", "--known", "shoes")
    result = done(build(network, *fusion))
    assert "Building a BM1, since the known variables are independent" in result.stderr
    assert load_deployment(network.parent / "out").machine.type == "BM1"
    result = done(build(network, *fusion, "--machine", "bm2"))
    assert "Building a BM2, since it was asked for" in result.stderr
    assert load_deployment(network.parent / "out").machine.type == "BM2"
    assert load_deployment(network.parent / "out").machine.lines == 4
    done(build(case, "--machine", "bm2"))  # a Model, too
    assert load_deployment(case.parent / "out").machine.variables == ("s", "K")
    assert_refused(build(network, *GRASS, "--machine", "bm1"), "joins them", "or use --machine bm2")


MARKOV = """MARKOV
3
2 3 2
2
2 0 1
2 1 2
6
1 2 3 4 5 6
6
1 2 3 4 5 6
"""
QUESTION = """
from toolchain.models import *

def model(searched: str = "inside") -> Question:
    pressure, inside = Symbol("pressure", IntegerType(1, 3)), Symbol("inside", IntegerType(0, 3))
    gauge, whistle = Symbol("gauge", IntervalType(0, 4, 8)), Symbol("whistle", LabelType("no", "yes"))
    joint = JointDistribution("boiler", (
        uniform(pressure), table(inside, [[0.1] * 3, [0.6, 0.1, 0.1], [0.2, 0.7, 0.1], [0.1, 0.1, 0.7]], given=[pressure]),
        conditional_normal(gauge, [inside], mean=lambda bar: bar, sigma=0.4),
        table(whistle, [[0.9, 0.9, 0.5, 0.1], [0.1, 0.1, 0.5, 0.9]], given=[inside])))
    return joint.ask(searched=[searched], known=[gauge, whistle])
"""


def test_questions_of_other_files_are_built_too(tmp_path):
    (tmp_path / "net.uai").write_text(MARKOV)
    done(build(tmp_path / "net.uai", "--searched", "0", "--known", "1,2"))
    assert load_deployment(tmp_path / "out").machine.variables == ("0", "1", "2")
    (tmp_path / "boiler").mkdir()
    (tmp_path / "boiler" / "model.py").write_text(QUESTION)
    for searched, machine in (("inside", "BM1"), ("pressure", "BM2")):
        done(build(tmp_path / "boiler", "--set", f"searched={searched}"))
        assert load_deployment(tmp_path / "out").machine.type == machine


BM1_FLAGS = (
    ("--scale", "none"), ("--prior-mode", "written"), ("--counter-bits", "9"), ("--stop", "own"), ("--per-cell",),
    ("--sensor-mode", "cell"), ("--replicas", "2"), ("--bits", "grass=3"), ("--prior-path", "data"),
    ("--device", "proce-v-d8"),
)  # fmt: skip
BM2_FLAGS = (
    ("--sequencer", "random"), ("--literal",), ("--sample-every", "move"), ("--burn-in", "3"),
    ("--ops-timeout", "9"), ("--stream", "4"),
)  # fmt: skip


def test_flags_of_the_other_machine_are_refused(network):
    for flag in BM1_FLAGS:
        refused = build(network, *GRASS, *flag)
        assert_refused(refused, flag[0], "BM1", "this is a BM2, since", "grass", "joins them; leave it out")
    for flag in BM2_FLAGS:
        fusion = build(network, "--searched", "rain", "--known", "grass", *flag)
        assert_refused(fusion, flag[0], "BM2", "this is a BM1, since", "--machine bm2")
    asked = build(network, *GRASS, "--machine", "bm2", *BM1_FLAGS[0])
    assert_refused(asked, "--scale is for a BM1, but this is a BM2 (--machine bm2); leave it out")
    asked = build(network, *GRASS, "--machine", "bm1", "--stream", "5")
    assert_refused(asked, "--stream", "this is a BM1 (--machine bm1); leave it out, or use --machine bm2")
    assert not (network.parent / "out").exists()
    for group, given in ((BM1Options, BM1_FLAGS), (BM2Options, BM2_FLAGS)):
        changed = replace(OPTIONS, **dict.fromkeys(group.__dataclass_fields__, "other"))
        assert set(given_flags(changed, group)) <= {flag[0] for flag in given}


def test_no_machine_is_advised_that_cannot_be_built(network):
    question = read_network(network).ask(["rain"], ["sprinkler", "grass"])  # they depend on each other
    for choice in ("auto", "bm2"):
        options = replace(OPTIONS, machine=MachineChoice(choice), scale="none")
        with pytest.raises(BuildError, match=r"--scale is for a BM1.*; leave it out$"):
            model_for(question, options)


# Bad input


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (
            ["--given", "either=no", "--given", "tub=yes"],
            ["P(either | lung, tub) is 0 everywhere where either = no"],
        ),
        (["--burn-in", str(2**32)], ["--burn-in is 4294967296"]),
        (["--rng-banks", "0"], ["--rng-banks is 0"]),
        (["--given", "either=yes,lung=no"], ["repeat --given"]),
        (["--given", "eithr=no"], ["no variable 'eithr'; did you mean 'either'?"]),
        (["--given", "either=noo"], ["either is never 'noo'; did you mean 'no'?"]),
        (["--known", "dysp,bronc"], ["bronc is in the question twice"]),
        (["--partitions", "0"], ["--partitions 0"]),
        (["--prob-bits", "1"], ["--prob-bits is 1; it must be from 2 to 16"]),
        (["--rng", "lfsr16"], ["lfsr16"]),
        (["--sequencer", "coloured", "--literal"], ["--sequencer coloured is not possible with --literal;"]),
        (["--steps-per-clock", "3"], ["--steps-per-clock is 3", "power of two"]),
        (["--stream", "5000"], ["--stream is 5000", "room for 4096 states of this machine"]),
        (["--samples", "0"], ["--samples is 0"]),
        (["--interface", "1x3"], ["interface 1x3", "use --interface 1x16"]),
    ],
)
def test_mistakes(asia, arguments, named):
    if "--known" not in arguments:
        arguments = ["--known", "smoke,dysp", *arguments]
    result = build(asia, "--searched", "bronc", "--machine", "bm2", *arguments)
    assert_refused(result, *named)
    assert not (asia.parent / "out").exists()


def test_given_values_that_exclude_each_other_are_refused():
    a, b, c = (Symbol(name, IntegerType(0, 1)) for name in "ABC")
    factors = (uniform(a), table(b, np.eye(2), given=[a]), table(c, np.eye(2), given=[a]))  # B = A = C
    joint = JointDistribution("copies", factors)
    chain_machines(plan_bm2(joint.ask(["A"], given={"B": "1", "C": "1"}).network(), OPTIONS))
    network = joint.ask(["A"], given={"B": "0", "C": "1"}).network()
    with pytest.raises(BuildError, match="copies: the given values are impossible together"):
        chain_machines(plan_bm2(network, OPTIONS))


def plan_of(*sizes, scope=None, searched=None):
    symbols = [Symbol(f"V{at}", IntegerType(0, size - 1)) for at, size in enumerate(sizes)]
    factors = [uniform(each) for each in symbols]
    if scope:
        factors.append(potential(symbols[:scope], np.random.default_rng(1).random(sizes[:scope])))
    joint = JointDistribution("wide", tuple(factors))
    return plan_bm2(joint.ask(symbols[:searched], symbols[searched or len(sizes) :]).network(), OPTIONS)


def test_what_is_too_large_is_named():
    assert isinstance(plan_of(4, 4), BM2Plan)
    with pytest.raises(
        BuildError, match="the potential of V0, V1, V2 is over 21 bits, .* the maximum is 20 bits"
    ):
        plan_of(128, 128, 128, scope=3)
    with pytest.raises(BuildError, match="4096 of V1 with 4096 values.*room for 4096: give V1 fewer values"):
        plan_of(1, 4096)
    with pytest.raises(BuildError, match="64 words of histograms .*4096: search fewer variables"):
        plan_of(16, 16, 16, 16)
    with pytest.raises(BuildError, match="8194 words .* and 2 .*: ask about fewer than 65 variables"):
        plan_of(2, *[128] * 64, searched=1)


@pytest.mark.parametrize("most", [39, 40])
def test_the_codes_of_all_factors_have_a_limit(monkeypatch, most):
    monkeypatch.setattr("toolchain.building.bm2_machine._MOST_CODES", most)
    what = "V0, V1 is over 4 bits, .* needs 32 codes; the maximum is 39 codes of all CDEs, which need 40"
    with pytest.raises(BuildError, match=what) if most == 39 else contextlib.nullcontext():
        plan_of(4, 4, scope=2)


# One part again


def regenerate(part, out, *arguments):
    return toolchain("regenerate", part, out, *arguments)


def test_memories_are_written_again_from_images_and_from_the_model(network):
    out = network.parent / "out"
    done(build(network, *GRASS, "--partitions", "2", "--interface", "2x20", "--samples", "77"))
    before = contents(out)
    (out / "bm_arch/Memory_MIFs/cde1.mif").write_text("something else")
    assert "unchanged  6 files" in done(regenerate("memories", out)).stdout
    assert contents(out) == before
    done(regenerate("memories", out, "--model", network, *GRASS))
    assert contents(out) == before
    network.write_text(network.read_text().replace("table 0.2, 0.8", "table 0.3, 0.7"))
    result = done(regenerate("memories", out, "--model", network, *GRASS))
    assert "bm_arch/Memory_MIFs/cde0.mif" in result.stdout
    after = contents(out)
    done(build(network, *GRASS, "--partitions", "2", "--interface", "2x20", "--samples", "77"))
    assert contents(out).keys() == after.keys()
    assert {name for name in after if after[name] != contents(out)[name]} <= {
        "boards/board0.bm",
        "boards/board1.bm",
    }
    question = ("--searched", "rain", "--known", "grass,sprinkler,shoes")
    assert_refused(
        regenerate("memories", out, "--model", network, *question), "the model knows", "build it again"
    )
    fixed = (*GRASS, "--given", "shoes=wet")
    assert_refused(regenerate("memories", out, "--model", network, *fixed), "other variables or factors")


def test_a_deployment_is_edited_if_its_images_agree(network):
    out = network.parent / "out"
    done(build(network, *GRASS))
    done(
        regenerate(
            "deployment", out, "--samples", "500", "--max-cycles", "9000", "--order", "grass,sprinkler"
        )
    )
    deployment = load_deployment(out)
    assert (deployment.machine.target_count, deployment.machine.max_cycles) == (500, 9000)
    assert [each.name for each in deployment.variables] == ["grass", "sprinkler"]
    assert_refused(regenerate("deployment", out, "--stop", "own"), "--stop is for a BM1", "BM2")
    result = done(regenerate("project", out))
    assert "the VHDL of a BM2 does not exist yet, so there is no project" in result.stderr
    file = out / "deployment.toml"
    file.write_text(file.read_text().replace("burn_in = 1000", "burn_in = 999"))
    assert_refused(regenerate("deployment", out), "burn_in = 999", "built with 1000")


@pytest.mark.parametrize(
    ("names", "named"),
    [
        ((), "number of names in 'variables'"),
        (("rain", "sprinkler"), "number of names in 'variables'"),
        (("sprinkler", "rain", "grass"), "searched variables"),
        (("rain", "sprinkler", "roof"), "known variables"),
    ],
)
def test_names_of_the_variables_are_those_of_the_images(network, names, named):
    done(build(network, *GRASS))
    deployment = load_deployment(network.parent / "out")
    images = read_images(deployment)
    check_agreement(deployment, images)
    wrong = deployment.replace(machine=deployment.machine.replace(variables=names))
    with pytest.raises(DeploymentError, match=named):
        check_agreement(wrong, images)


def test_a_machine_that_streams_its_states_names_all_variables_in_them(network):
    question = ("--searched", "rain", "--known", "grass", "--machine", "bm2")
    out = network.parent / "out"
    done(build(network, *question))
    plain = load_deployment(out)
    assert (plain.hidden, plain.state_dimensions) == ((), ())
    done(build(network, *question, "--stream", "16"))
    deployment = load_deployment(out)
    assert [each.label for each in deployment.hidden] == ["sprinkler"]
    assert [each.label for each in deployment.state_dimensions] == list(deployment.machine.variables)
    assert {(each.size, len(each.states)) for each in deployment.state_dimensions} == {(2, 2)}
    (sprinkler,) = deployment.hidden
    wrong = sprinkler.replace(size=3, states=("a", "b", "c"))
    with pytest.raises(DeploymentError, match="values of sprinkler"):
        check_agreement(deployment.replace(hidden=(wrong,)), read_images(deployment))


def test_sources_give_a_path_to_each_variable(network):
    file = network.parent / "sources.toml"
    file.write_text(
        '[[source]]\ntopic = "/a"\ntype = "a/A"\nvariables = {grass = "wet[0]"}\n\n'
        '[[source]]\ntopic = "/b"\ntype = "a/A"\n'
    )
    out = network.parent / "out"
    done(toolchain("build", network, "-o", out, *GRASS, "--uri", "ws://a:1", "--sources", file))
    sprinkler, grass = load_deployment(out).variables
    assert (sprinkler.source, grass.source, grass.path) == (1, 0, "wet[0]")
    file.write_text(file.read_text() + 'prior = "p"\n')
    refused = toolchain("build", network, "-o", out, *GRASS, "--uri", "ws://a:1", "--sources", file)
    assert_refused(refused, "a prior in the file of --sources is for a BM1")
