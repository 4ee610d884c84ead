"""Filters: from two slices of a network to the deployment and its machine, compared with whole unrolled networks.

P(x | x0), P(k | x) ──▶ Transition ──▶ filter.npy ──▶ Filter: predict ─▶ machine ─▶ update
"""

import hashlib
import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from machines.encode import decode_code
from machines.posterior import posterior as run_machine
from pcie_shim.programming_file import read_image
from posteriors import posterior
from tests.toolchain.running import TARGET, assert_refused, build_model, done, toolchain
from toolchain.analysis.emulation import joined
from toolchain.building.choice import model_for
from toolchain.building.options import BuildOptions, MachineChoice
from toolchain.building.regenerate import regenerate_memories
from toolchain.deployment import filter as filters
from toolchain.deployment import load_deployment
from toolchain.deployment.filter import Filter, Transition, prediction_codes
from toolchain.errors import BuildError, DamagedDeploymentError, DeploymentError, ModelError
from toolchain.models.distribution import IntegerType, LabelType, Symbol, potential, table, uniform
from toolchain.models.joint import JointDistribution
from toolchain.models.model import exact_posterior

UMBRELLA = """
variable rain0 { type discrete [ 2 ] { yes, no }; }
variable rain { type discrete [ 2 ] { yes, no }; }
variable umbrella { type discrete [ 2 ] { yes, no }; }
probability ( rain0 ) { table 0.5, 0.5; }
probability ( rain | rain0 ) { (yes) 0.7, 0.3; (no) 0.3, 0.7; }
probability ( umbrella | rain ) { (yes) 0.9, 0.1; (no) 0.2, 0.8; }
"""
ASKED = ("--searched", "rain", "--previous", "rain0", "--known", "umbrella")


@pytest.fixture
def umbrella(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "umbrella.bif").write_text(UMBRELLA)
    return "umbrella.bif"


def two_slices(seed):
    """x and y depend on x0 and y0, of which y0 depends on x0; wind is hidden, and a and b are known."""
    random = np.random.default_rng(seed)

    def drawn(symbol, *given):
        shape = [symbol.size, *(each.size for each in given)]
        numbers = random.random(shape) ** 3
        if symbol.name == "x0":
            numbers[0] = 0  # a value that the start excludes, and that is reached later
        return table(symbol, numbers / numbers.sum(axis=0), given=list(given))

    x0, y0, x, y = (Symbol(name, IntegerType(0, 2 if "x" in name else 1)) for name in ("x0", "y0", "x", "y"))
    wind, a, b = (Symbol(name, IntegerType(0, 2)) for name in ("wind", "a", "b"))
    factors = [drawn(x0), drawn(y0, x0), drawn(wind), drawn(x, y0, x0, wind), drawn(y, x, y0)]
    return JointDistribution("slices", (*factors, drawn(a, x), drawn(b, y, x)))


def unrolled(joint, frames):
    """The network of some frames: the slices with x and y as x0 and y0 of the next."""
    factors = [factor for factor in joint.factors if factor.symbol.name.endswith("0")]
    for frame in range(1, frames + 1):

        def at_frame(symbol, frame=frame):
            earlier = symbol.name.endswith("0")
            return Symbol(f"{symbol.name.removesuffix('0')}{frame - earlier}", symbol.type)

        factors += [
            table(at_frame(factor.symbol), factor.table, given=[at_frame(each) for each in factor.given])
            for factor in joint.factors
            if not factor.symbol.name.endswith("0")
        ]
    return JointDistribution("unrolled", tuple(factors))


@pytest.mark.parametrize("seed", range(4))
def test_the_filter_is_exact_inference_on_the_unrolled_network(seed):
    joint = two_slices(seed)
    model = joint.ask(["y", "x"], ["a", "b"], previous=["y0", "x0"]).model()
    assert model.transition is not None
    readings = [(0, 2), (1, 1), (2, 0)]
    belief = model.transition.start
    assert belief.reshape(2, 3)[:, 0].sum() == 0
    for frame, addresses in enumerate(readings, start=1):
        belief = model.transition.after(belief)
        belief = exact_posterior(model, addresses, prior=belief)
        known = [f"{name}{at}" for at in range(1, frame + 1) for name in ("a", "b")]
        whole = unrolled(joint, frame).ask([f"y{frame}", f"x{frame}"], known).network()
        assert belief == pytest.approx(whole.exact(list(itertools.chain(*readings[:frame]))), rel=1e-9)
    first = exact_posterior(model, readings[0])
    assert first == pytest.approx(exact_posterior(joint.ask(["y", "x"], ["a", "b"]).model(), readings[0]))


X0, X, K = (Symbol(name, LabelType("a", "b")) for name in ("x0", "x", "k"))
HALF = [[0.6, 0.3], [0.4, 0.7]]
START = table(X0, [0.5, 0.5])
RIGHT = [table(X, HALF, given=[X0]), table(K, HALF, given=[X])]
HIDDEN, OTHER = Symbol("h", LabelType("a", "b")), Symbol("z", LabelType("p", "q"))


@pytest.mark.parametrize(
    ("factors", "question", "named"),
    [
        (RIGHT, {"previous": ["x0", "h"]}, "1 searched and 2"),
        (RIGHT, {"previous": ["z"]}, "z, the previous x, does"),
        ([table(X, [0.5, 0.5]), table(K, HALF, given=[X])], {}, "x does not depend on x0"),
        (
            [table(X, HALF, given=[X0]), table(K, HALF, given=[X0])],
            {},
            "k is not independent of the previous frame",
        ),
        (
            [table(X, [HALF, [[0.4, 0.7], [0.6, 0.3]]], given=[X0, HIDDEN]), table(K, HALF, given=[HIDDEN])],
            {},
            "k <- h -> x <- x0",
        ),
        ([potential([X0, X], HALF), table(K, HALF, given=[X])], {}, "potential of x0, x is none"),
        (RIGHT, {"given": {"h": "a"}}, "leave h out"),
        (RIGHT, {"prior_select": "h"}, "leave h out"),
        (RIGHT, {"previous": ["x"]}, "x is in the question twice"),
        (RIGHT, {"previous": ["x9"]}, "did you mean"),
    ],
)
def test_questions_that_are_no_filter(factors, question, named):
    joint = JointDistribution("n", (START, *factors, table(HIDDEN, [0.5, 0.5]), table(OTHER, [0.5, 0.5])))
    with pytest.raises(ModelError) as caught:
        joint.ask(["x"], ["k"], **({"previous": ["x0"]} | question)).model()
    assert named in str(caught.value)


def test_a_previous_variable_depends_on_previous_ones_alone():
    factors = (table(HIDDEN, [0.5, 0.5]), table(X0, HALF, given=[HIDDEN]), table(X, HALF, given=[X0]))
    joint = JointDistribution("n", (*factors, table(K, HALF, given=[X])))
    with pytest.raises(ModelError, match="x0, which is previous, depends on h, which is not"):
        joint.ask(["x"], ["k"], previous=["x0"]).model()
    with pytest.raises(ModelError, match="x, which is previous, depends on"):
        joint.ask(["x0"], ["k"], previous=["x"]).model()


def test_too_many_transitions_are_refused():
    s0, s, t0, t = (Symbol(name, IntegerType(0, 69)) for name in ("s0", "s", "t0", "t"))
    factors = [
        uniform(s0),
        uniform(t0),
        *(table(new, np.eye(70), given=[old]) for new, old in ((s, s0), (t, t0))),
    ]
    joint = JointDistribution("n", (*factors, table(K, np.full((2, 70), 0.5), given=[s])))
    with pytest.raises(ModelError, match="24010000 entries; the maximum is 16777216: search fewer"):
        joint.ask(["s", "t"], ["k"], previous=["s0", "t0"]).model()


def sticky(stay=0.9999, **more):
    """A door that rarely moves."""
    moves = [[stay, 1 - stay], [1 - stay, stay]]
    factors = (START, table(X, moves, given=[X0]), table(K, [[0.8, 0.2], [0.2, 0.8]], given=[X]))
    return replace(JointDistribution("door", factors).ask(["x"], ["k"], previous=["x0"]).model(), **more)


def test_a_model_and_its_transition_agree():
    model = sticky()
    assert model.prior == pytest.approx([0.5, 0.5])
    with pytest.raises(ModelError, match="predicted from its transition"):
        replace(model, prior=np.array([0.4, 0.6]))
    with pytest.raises(ModelError, match="3 lines, but the searched dimensions have 2"):
        replace(model, transition=Transition(np.full(3, 1 / 3), np.eye(3)))
    for start, moves in (
        ([1.0, 0.0], np.eye(3)),
        ([0.5, 0.4], np.eye(2)),
        ([0.5, 0.5], -np.eye(2)),
        (1.0, 1.0),
    ):
        with pytest.raises(ModelError, match="transition"):
            Transition(np.array(start), np.array(moves))


def test_the_prediction_moves_on_and_no_value_is_excluded_by_rounding(monkeypatch):
    moves = np.array([[0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    own = Filter(Transition(np.array([1.0, 0, 0, 0]), moves), 16)
    assert own.predict().tolist() == [65535, 65535, 0, 0]
    own.update(None)
    own.predict(2)
    assert own.belief == pytest.approx([0.125, 0.375, 0.5, 0])
    own.update(np.array([0, 0, 1e-7, 1.0]))
    assert own.predict().tolist() == [0, 0, 1, 65535]
    monkeypatch.setattr(filters, "_MOST_WORK", 32)
    capped = Filter(own.transition, 8)
    capped.predict(10**9)
    assert capped.belief == pytest.approx([0.25, 0.5, 0.25, 0])
    assert prediction_codes(np.array([0.001, 0.999, 0]), 8).tolist() == [1, 255, 0]


def test_a_door_that_rarely_moves_is_followed(tmp_path):
    """With 8 bits, the chance to move would be the code 0, and no reading would ever move the belief."""
    build_model(sticky(), tmp_path, prob_bits=8, target_count=255)
    deployment = load_deployment(tmp_path)
    machine, own = read_image(deployment.image_path(0)).machine, deployment.new_filter()
    for frame in range(40):
        codes = own.predict()
        own.update(run_machine(machine, [int(frame >= 20)], prior_codes=codes, bank=frame % 16))
        if frame == 19:
            assert own.belief[0] > 0.9
    assert own.belief[1] > 0.9


def test_a_network_becomes_a_machine_with_a_filter(umbrella):
    done(toolchain("build", umbrella, *ASKED, "-o", "built", *TARGET))
    deployment = load_deployment("built")
    machine = deployment.machine
    assert (machine.prior_mode, machine.prob_bits, deployment.filter.file) == ("written", 16, "filter.npy")
    assert done(toolchain("check", "built")).stdout == ""
    own = deployment.new_filter()
    whole = joined([read_image(deployment.image_path(0)).machine])
    assert whole.prior[0].tolist() == own.predict().tolist()
    alone = posterior("built", {"umbrella": "yes"})
    assert list(alone.probabilities) == run_machine(whole, [0]).tolist()
    # Russell and Norvig, Artificial Intelligence, 15.2.1
    exact = own.transition.after(np.array([0.9 * 0.5, 0.2 * 0.5]) / 0.55)
    assert exact == pytest.approx([0.627, 0.373], abs=5e-4)
    assert decode_code(whole.tables[0][0], 16)[1] == pytest.approx(0.2 / 0.9, abs=1e-4)


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--replicas", "2"], "--replicas cannot be used with a filter"),
        (["--prior-mode", "table"], "--prior-mode table cannot be used with a filter"),
        (["--sensor-mode", "cell"], "--sensor-mode cell cannot be used with a filter"),
        (["--prior-path", "p"], "--prior-path cannot be used with a filter"),
        (["--machine", "bm2"], "a filter needs a BM1"),
        (["--known", "umbrella,rain0"], "rain0 is in the question twice"),
    ],
)
def test_options_that_are_not_for_a_filter(umbrella, more, named):
    assert_refused(toolchain("build", umbrella, *ASKED, "-o", "built", *TARGET, *more), named)


def test_a_question_for_a_bm2_has_no_filter():
    a, b = Symbol("a", LabelType("n", "y")), Symbol("b", LabelType("n", "y"))
    more = (table(a, HALF, given=[X]), table(b, [HALF, HALF[::-1]], given=[X, a]))
    joint = JointDistribution("n", (START, table(X, HALF, given=[X0]), *more))
    options = BuildOptions(uri="ws://robot:9090", topic="/r", type="std_msgs/Float64")
    with pytest.raises(BuildError, match="a filter needs a BM1.*a and b are not independent"):
        model_for(joint.ask(["x"], ["a", "b"], previous=["x0"]), options)
    with pytest.raises(BuildError, match="a filter needs a BM1"):
        model_for(sticky(), replace(options, machine=MachineChoice.BM2))


def test_previous_is_for_a_network(case):
    assert_refused(
        toolchain("build", case, "--previous", "x", "-o", "built", *TARGET), "--previous is for a network"
    )


def test_the_file_of_the_filter_is_guarded(tmp_path):
    build_model(sticky(), tmp_path)
    path = tmp_path / "filter.npy"
    good, text = path.read_bytes(), (tmp_path / "deployment.toml").read_text()
    assert np.load(path).tolist() == [[0.5, 0.5], *sticky().transition.table.tolist()]

    def refused(error, match):
        with pytest.raises(error, match=match):
            load_deployment(tmp_path)
        assert load_deployment(tmp_path, images=False).filter is not None

    path.write_bytes(good[:-1] + b"\0")
    refused(DamagedDeploymentError, "filter.npy is of another build, or damaged: its hash is")
    path.write_bytes(good + bytes(5000))
    refused(DeploymentError, "more than .* bytes, the maximum")
    path.unlink()
    refused(DamagedDeploymentError, "filter.npy, the filter's start and transition, does not exist")
    path.write_bytes(good)
    for key, value, match in (
        ("prior_mode", '"table"', "writes the prior of a single machine"),
        ("file", '"../filter.npy"', "must be a path inside"),
    ):
        lines = [f"{key} = {value}" if row.startswith(f"{key} =") else row for row in text.splitlines()]
        (tmp_path / "deployment.toml").write_text("\n".join(lines))
        with pytest.raises(DeploymentError, match=match):
            load_deployment(tmp_path, edited=True)


@pytest.mark.parametrize(
    "content",
    [
        *(
            np.zeros((2, 2)),
            np.zeros((3, 2), "<f4"),
            np.full((3, 2), 0.4),
            np.asfortranarray(np.full((3, 2), 0.5)),
        ),
        *(b"\x93NUMPY\x01\x00", b"\x93NUMPY\x01\x00\xd0\x07" + b"(" * 2000),
    ],
)
def test_a_file_with_the_right_hash_is_read_with_care(tmp_path, content):
    path = tmp_path / "filter.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(DamagedDeploymentError, match=r"is not float64\[3, 2\]"):
        Transition.read(path, 2, hashlib.sha256(path.read_bytes()).hexdigest())


def test_a_build_and_a_regeneration_replace_the_file(tmp_path):
    build_model(sticky(), tmp_path)
    before = load_deployment(tmp_path)
    assert all(change == "unchanged" for _, change in regenerate_memories(tmp_path, sticky()))
    changes = dict(regenerate_memories(tmp_path, sticky(0.8)))
    assert (changes["filter.npy"], changes["deployment.toml"]) == ("changed", "changed")
    after = load_deployment(tmp_path)
    assert after.new_filter().transition.table[0, 0] == 0.8
    assert after.hash != before.hash
    with pytest.raises(
        BuildError, match="the model has no filter, but the deployment one: give the same --previous"
    ):
        regenerate_memories(tmp_path, replace(sticky(), transition=None))
    build_model(replace(sticky(), transition=None), tmp_path)
    with pytest.raises(BuildError, match="the model has a filter, but the deployment none"):
        regenerate_memories(tmp_path, sticky())
    assert not (tmp_path / "filter.npy").exists()
    assert load_deployment(tmp_path).new_filter() is None


def test_inspect_compares_sequences_with_the_exact_filter(umbrella, tmp_path):
    done(toolchain("build", umbrella, *ASKED, "-o", "built", "--target-count", "255", *TARGET))
    model = ("--model", umbrella, *ASKED)
    found = json.loads(done(toolchain("inspect", "built", *model, "--json")).stdout)["accuracy"]
    assert found["banks"] == 1
    assert 0 < found["machine"]["total_variation"]["value"] < 0.03
    assert found["machine"]["map_agreement"]["value"] > 0.95
    # of single frames without the filter, the machine would know much less
    single = json.loads(
        done(toolchain("query", umbrella, "--searched", "rain", "--known", "umbrella=yes", "--json")).stdout
    )
    assert single["posterior"][0]["exact"] == pytest.approx(0.818, abs=1e-3)
    (tmp_path / "walk.csv").write_text("umbrella\n" + "yes\nyes\nnever\nno\n" * 5)
    said = done(toolchain("inspect", "built", *model, "--readings", "walk.csv")).stdout
    assert "20 of 20 rows of walk.csv, without 5 that do not fit" in said
    assert "the machine against the exact filter" not in said
    assert "machine against the exact filter" in said
    without = done(
        toolchain(
            "inspect", "built", "--model", umbrella, "--searched", "rain", "--known", "umbrella", "--json"
        )
    )
    assert json.loads(without.stdout)["accuracy"] == found  # the transition is the deployment's
    assert "drawn from the codes" in done(toolchain("inspect", "built", "--frames", "5")).stdout
    other = UMBRELLA.replace(
        "0.7, 0.3; (no) 0.3, 0.7", "0.6, 0.4; (no) 0.4, 0.6"
    )  # with the same first prior
    (tmp_path / umbrella).write_text(other)
    assert_refused(toolchain("inspect", "built", *model), "its transition differs")
