"""`query` and `show`: exact answers, those of machines as builds have them, and one sentence for whatever is wrong."""

import itertools
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from posteriors import posterior
from rosbayes.__main__ import app
from tests.command_runner import invoke
from tests.toolchain.running import TARGET, assert_refused, done, toolchain
from toolchain.analysis import query as queries
from toolchain.building.options import MachineChoice
from toolchain.networks import read_network

PAGE = (Path(__file__).parents[3] / "docs" / "how-to" / "query.md").read_text()
ASIA = re.search(r"```bif\n(.*?)```", PAGE, re.DOTALL)[1]


@pytest.fixture
def asia(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "asia.bif").write_text(ASIA)
    return "asia.bif"


def asked(*arguments):
    return json.loads(done(toolchain("query", *arguments, "--json")).stdout)


@pytest.mark.usefixtures("asia")
def test_the_page_works_as_printed():
    printed = re.findall(r"^    rosbayes ([^\n]+)\n(?:\n```text\n(.*?)```)?", PAGE, re.MULTILINE | re.DOTALL)
    assert [bool(output) for _, output in printed] == [True, True, True, False]
    for command, output in printed:
        said = done(invoke(app, shlex.split(command))).stdout
        assert not output or said == output


def test_an_answer_is_exact(asia):
    found = asked(asia, "--searched", "lung,bronc", "--known", "smoke=yes,xray=no")
    assert (found["network"], found["searched"], found["machine"]) == ("asia", ["lung", "bronc"], None)
    assert found["known"] == {"smoke": "yes", "xray": "no"}
    factors = read_network(asia).factors
    by_name = {factor.symbol.name: factor.table for factor in factors}
    tub = by_name["tub"] @ by_name["asia"]
    seen = np.einsum("elt,t,e->l", by_name["either"], tub, by_name["xray"][1])
    lung = by_name["lung"][:, 0] * seen
    expected = np.outer(lung / lung.sum(), by_name["bronc"][:, 0]).ravel()
    states = [{"lung": one, "bronc": other} for one, other in itertools.product(("yes", "no"), repeat=2)]
    assert [row["states"] for row in found["posterior"]] == states
    assert [row["exact"] for row in found["posterior"]] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("machine", "chosen", "known"),
    [
        ("auto", "BM1", {"dysp": "yes"}),
        ("bm1", "BM1", {"dysp": "no"}),
        ("auto", "BM2", {"smoke": "yes", "dysp": "yes"}),
        ("bm2", "BM2", {"smoke": "no"}),
    ],
)
def test_a_machine_says_what_its_deployment_says(asia, machine, chosen, known):
    question = (asia, "--searched", "bronc", "--machine", machine)
    found = asked(*question, *(f"--known={name}={state}" for name, state in known.items()))
    assert found["machine"]["kind"] == chosen
    done(toolchain("build", *question, "--known", ",".join(known), "-o", "built", *TARGET))
    assert [row["machine"] for row in found["posterior"]] == list(posterior("built", known).probabilities)
    difference = sum(abs(row["machine"] - row["exact"]) for row in found["posterior"]) / 2
    assert found["machine"]["total_variation"] == pytest.approx(difference)
    assert 0 < difference < 0.1
    assert found["machine"]["cycles"] > 200


def test_a_machine_without_a_posterior(tmp_path):
    # each line is likely for one of the readings only, so that no line counts at both
    path = tmp_path / "torn.bif"
    path.write_text(
        "variable x { type discrete [ 2 ] { a, b }; }\n"
        "variable one { type discrete [ 2 ] { a, b }; }\nvariable two { type discrete [ 2 ] { a, b }; }\n"
        "probability ( x ) { table 0.5, 0.5; }\n"
        "probability ( one | x ) { (a) 0.9999, 0.0001; (b) 0.0001, 0.9999; }\n"
        "probability ( two | x ) { (a) 0.0001, 0.9999; (b) 0.9999, 0.0001; }\n"
    )
    question = (path, "--searched", "x", "--known", "one=a,two=a", "--machine", "bm1")
    found = asked(*question)
    assert [row["exact"] for row in found["posterior"]] == pytest.approx([0.5, 0.5])
    assert [set(row) for row in found["posterior"]] == [{"states", "exact"}] * 2
    assert found["machine"]["total_variation"] == 1
    said = done(toolchain("query", *question)).stdout.splitlines()
    assert said[1].split() == ["x", "exact"]
    assert "no posterior" in said[-2]


def test_the_most_probable_states_together(tmp_path):
    # x = b is more probable than x = a, but not together with any state of y
    path = tmp_path / "pair.bif"
    path.write_text(
        "variable x { type discrete [ 2 ] { a, b }; }\nvariable y { type discrete [ 3 ] { c, d, e }; }\n"
        "probability ( x ) { table 0.4, 0.6; }\nprobability ( y | x ) { (a) 1, 0, 0; (b) 0.1, 0.45, 0.45; }\n"
    )
    question = (path, "--searched", "x,y", "--machine", "bm1")
    said = done(toolchain("query", *question, "--map")).stdout.splitlines()
    assert said[0] == "pair: max P(x, y)"
    assert said[2].split()[:3] == ["a", "c", "0.4000"]
    assert len(said) == 5
    assert said[3].endswith(", the same most probable states.")
    found = asked(*question)
    assert found["map"] == found["machine"]["map"] == {"x": "a", "y": "c"}
    answer = queries.answer(read_network(path), ["x", "y"], {}, MachineChoice.BM1)
    other = replace(answer.machine, posterior=np.eye(6)[4])
    rows = replace(answer, machine=other).report(best=True).splitlines()
    assert [row.split()[:2] for row in rows[2:4]] == [["a", "c"], ["b", "d"]]
    assert rows[4].endswith(", other most probable states.")
    assert json.loads(replace(answer, machine=other).as_json())["machine"]["map"] == {"x": "b", "y": "d"}
    lost = replace(answer, machine=replace(other, posterior=None))
    assert json.loads(lost.as_json())["machine"]["map"] is None
    assert len(lost.report(best=True).splitlines()) == 5


def test_of_many_combinations_the_most_probable_are_shown(asia):
    said = done(toolchain("query", asia, "--searched", "asia,tub,smoke,lung,bronc,xray")).stdout.splitlines()
    assert len(said) == 1 + 1 + 40 + 1
    assert said[2].split()[:6] == ["no", "no", "no", "no", "no", "no"]
    shown = [float(re.search(r"\d\.\d{4}", row)[0]) for row in said[2:-1]]
    assert shown == sorted(shown, reverse=True)
    rest = re.match(r"and 24 less probable ones, together (\S+)", said[-1])[1]
    assert sum(shown) + float(rest) == pytest.approx(1, abs=41 * 0.00005)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--searched", "bron"], ["'bron'", "did you mean 'bronc'?"]),
        (["--searched", "bronc", "--known", "smok=yes"], ["'smok'", "did you mean 'smoke'?"]),
        (["--searched", "bronc", "--known", "smoke=ye"], ["smoke", "'ye'", "did you mean 'yes'?"]),
        (["--searched", "bronc", "--known", "smoke"], ["--known smoke", "smoke=yes"]),
        (["--searched", "bronc", "--known", "bronc=yes"], ["bronc is in the question twice"]),
        (["--searched", "bronc", "--known", "tub=yes,tub=no"], ["--known tub is given twice"]),
        (["--searched", "bronc", "--known", "tub=yes,either=no"], ["impossible together"]),
        (["--searched", "tub", "--known", "smoke=no,dysp=no", "--machine", "bm1"], ["smoke and dysp"]),
    ],
)
def test_mistakes_of_a_query(asia, arguments, named):
    assert_refused(toolchain("query", asia, *arguments), *named)


def test_other_files_and_folders(case, asia):
    assert_refused(toolchain("query", case, "--searched", "x"), case, ".xdsl, with or without .gz")
    assert_refused(toolchain("show", "no.bif"), "no.bif", "No such file")
    assert_refused(toolchain("show", asia, "--known", "tub"), "--known tub", "--searched")
    assert_refused(toolchain("show", asia, "--searched", "tb"), "did you mean 'tub'?")
    assert_refused(toolchain("show", asia, "--searched", "tub", "--known", "lugn"), "did you mean 'lung'?")


@pytest.mark.parametrize("searched", ["bronc", "either", "smoke,either", "dysp"])
def test_show_keeps_apart_what_a_bm1_refuses(asia, searched):
    names = searched.split(",")
    found = json.loads(done(toolchain("show", asia, "--searched", searched, "--json")).stdout)
    apart = {each["name"]: each["not_with"] for each in found["variables"] if "not_with" in each}
    joint = read_network(asia)
    assert set(apart) == {symbol.name for symbol in joint.symbols} - set(names)
    for one, other in itertools.permutations(apart, 2):
        refusal = joint.ask(names, [one, other]).refusal()
        assert (other in apart[one]) is (refusal is not None)
    taken = []
    for name, others in apart.items():
        if not set(taken) & set(others):
            taken.append(name)
    assert joint.ask(names, taken).refusal() is None


def test_show_lists_states_and_parents(asia, tmp_path, monkeypatch):
    rows = done(toolchain("show", asia)).stdout.splitlines()
    assert rows[0] == "asia: 8 variables, 8 tables"
    assert rows[1].split() == ["variable", "states", "depends", "on"]
    assert rows[-1].split() == ["dysp", "yes,", "no", "bronc,", "either"]
    (tmp_path / "n.uai").write_text("BAYES 1 3 1 1 0 3 0.2 0.3 0.5")
    assert done(toolchain("show", "n.uai")).stdout.splitlines()[-1].split() == ["0", "0", "to", "2"]
    alone = done(toolchain("show", asia, "--searched", "bronc", "--known", "smoke,asia")).stdout.splitlines()
    assert [row.split() for row in alone[2:-1]] == [
        ["asia", "yes,", "no"],
        ["smoke", "yes,", "no"],
        ["bronc", "yes,", "no", "smoke", "(searched)"],
    ]
    monkeypatch.setattr(queries, "_MOST_NAMES", 2)
    shortened = done(toolchain("show", asia, "--searched", "bronc")).stdout.splitlines()
    assert shortened[-2].endswith("asia, tub and 4 more")
    monkeypatch.setattr(queries, "MOST_CANDIDATES", 6)
    assert_refused(toolchain("show", asia, "--searched", "bronc"), "7 variables", "--known A,B")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.text(max_size=12) | st.sampled_from(["bronc", "bronc,tub"]),
    st.lists(st.text(max_size=12) | st.sampled_from(["tub=no", "dysp=yes,", "lung=no,tub=yes"]), max_size=2),
)
def test_any_question_is_answered_or_refused(asia, searched, known):
    arguments = ["--searched=" + searched, *("--known=" + text for text in known)]
    ended = toolchain("query", asia, *arguments)
    assert ended.exit_code in {0, 2}
    assert "Traceback" not in ended.output
