"""`toolchain check`, `inspect` and `advise` for questions that a BM2 answers."""

import json

import pytest

from tests.toolchain.running import TARGET, assert_refused, done, toolchain
from toolchain.analysis import AdviceOptions
from toolchain.analysis.advice import Candidate, _recommendation, _run_until, _why_short, advise
from toolchain.commands.request import ModelFlags, read_source

QUESTION = ("--searched", "rain", "--known", "sprinkler,grass")
"""A BM1 cannot answer it: both are causes of the grass."""


@pytest.fixture
def deployment(network, tmp_path):
    folder = tmp_path / "built"
    done(
        toolchain(
            "build", network, *QUESTION, "-o", folder, *TARGET, "--samples", "2000", "--partitions", "2"
        )
    )
    return folder


def test_check_names_factors_of_a_network_and_of_a_deployment(network, deployment):
    said = done(toolchain("check", network, *QUESTION)).stdout
    assert "note: P(grass | sprinkler, rain): 3 of its 12 odds are clipped" in said
    refused = toolchain("check", network, *QUESTION, "--machine", "bm1")
    assert (
        refused.exit_code,
        refused.stdout.startswith("error: the model: sprinkler and grass are not"),
    ) == (2, True)
    findings = [
        json.loads(line) for line in done(toolchain("check", deployment, "--json")).stdout.splitlines()
    ]
    assert {each["check"] for each in findings} == {"clipped-factors", "ambiguous-states"}
    (
        deployment / "bm_arch" / "Memory_MIFs" / next((deployment / "bm_arch" / "Memory_MIFs").iterdir()).name
    ).unlink()
    assert "is not there" in done(toolchain("check", deployment)).stdout


def test_inspect(network, deployment):
    said = done(toolchain("inspect", deployment, "--model", network, *QUESTION, "--frames", "4")).stdout
    assert "a BM2 with 2 chains, one per board" in said
    assert "R-hat" in said
    assert "3 variables in 3 bits; 3 CDEs with 17 codes of 16 bits, at most 12." in said
    assert "Total variation from exact inference: 0.0" in said
    found = json.loads(done(toolchain("inspect", deployment, "--json", "--frames", "4")).stdout)
    assert (found["state_bits"], found["table_words"], found["exact"]) == (3, [1, 4, 12], None)
    assert found["sampled"]["total_variation"] is None
    assert found["sampled"]["cycles"]["worst"] >= 3000
    assert found["resources"]["fits"]


def test_inspect_says_why_no_reading_gives_a_posterior(network, tmp_path):
    out = tmp_path / "hasty"
    done(toolchain("build", network, *QUESTION, "-o", out, *TARGET, "--ops-timeout", "1"))
    assert_refused(toolchain("inspect", out, "--frames", "2"), "boards stopped by: ops_timeout 2")
    done(toolchain("build", network, *QUESTION, "-o", out, *TARGET))
    assert "R-hat" not in done(toolchain("inspect", out, "--frames", "2")).stdout  # there is one board


def test_explore_is_for_a_bm1(network):
    assert_refused(
        toolchain("explore", network, *QUESTION), "explore is for a BM1, but sprinkler and grass", "advise"
    )


def test_inspect_refuses_what_it_cannot_do(network, deployment):
    question = ("--searched", "rain", "--known", "grass")
    assert_refused(
        toolchain("inspect", deployment, "--model", network, *question), "garden", "its codes differ"
    )
    assert_refused(toolchain("inspect", deployment, "--readings", "a.csv"), "--readings a.csv")


def test_advice_about_both_machines(network):
    question = ("--searched", "rain", "--known", "grass", "--accuracy", "0.03", "--frames", "5")
    found = json.loads(done(toolchain("advise", network, *question, "--json")).stdout)
    assert found["question"] == "P(rain | grass)"
    one, two = found["machines"]
    assert (one["machine"], two["machine"], one["refused"], two["refused"]) == ("BM1", "BM2", "", "")
    assert max(one["total_variation"], two["total_variation"]) <= 0.03
    assert one["cycles"] < two["cycles"]
    assert one["seconds"] == pytest.approx(one["cycles"] / 100e6)
    assert found["exact_seconds"] > 0
    said = done(toolchain("advise", network, *question, "--clock", "1e3")).stdout
    assert "time at 1 kHz" in said
    assert said.splitlines()[-1].startswith("Use a CPU: exact inference on a CPU takes ")


def test_advice_says_why_a_bm1_cannot_answer(network):
    said = done(toolchain("advise", network, *QUESTION, "--accuracy", "0.05", "--frames", "5")).stdout
    assert "BM1: sprinkler and grass are not independent given rain" in said
    assert "BM2" in said.splitlines()[1]
    found = json.loads(
        done(toolchain("advise", network, *QUESTION, "--accuracy", "0.5", "--frames", "5", "--json")).stdout
    )
    assert [each["cycles"] is None for each in found["machines"]] == [True, False]
    assert_refused(toolchain("advise", network), "give the searched and known variables")
    assert_refused(toolchain("advise", network, *QUESTION, "--device", "x"), "--device x")


def test_advice_tells_what_it_runs(network):
    begun = []
    source = read_source(network, ModelFlags(searched="rain", known="grass"))
    advise(source, AdviceOptions(accuracy=0.3, frames=2), begun.append)
    assert begun[:3] == ["exact inference", "BM1, codes of 8 bits", "BM1, target count 255"]
    assert "BM2, 1,000 samples" in begun[3:]


@pytest.mark.parametrize(
    ("machine", "words"),
    [
        (
            Candidate("BM2", "", 16, 3_000_000, 0.002, 29_990_000),
            ("limit of 30,000,000 cycles", "--accuracy", "with about --samples 12000000."),
        ),
        (
            Candidate("BM1", "", 8, 1_000_000, 0.002, 30_100_000),
            ("limit of 30,000,000 cycles", "--accuracy", "with about --target-count 4000000."),
        ),
        (Candidate("BM1", "", 16, 5000, 0.002, 9000), ("codes of 16 bits, not its cycles", "--accuracy")),
    ],
)
def test_a_machine_that_is_less_accurate_says_why(machine, words):
    said = _why_short(machine, 0.001)
    assert [each for each in words if each not in said] == []


FAST = Candidate(machine="BM1", total_variation=0.01, seconds=1e-6)
SLOW = Candidate(machine="BM2", total_variation=0.01, seconds=1e-3)


@pytest.mark.parametrize(
    ("machines", "exact", "words"),
    [
        ((FAST, SLOW), 1e-4, "Use a BM1: a BM1 takes 1 us, and exact inference on a CPU takes 100 us"),
        ((FAST, SLOW), 1e-7, "Use a CPU: exact inference on a CPU takes 100 ns, and a BM1 takes 1 us"),
        ((Candidate(machine="BM1", refused="no"), SLOW), 1e-2, "Use a BM2: a BM2 takes 1 ms, and exact"),
        ((Candidate(machine="BM1", refused="no"),), 1e-4, "and no machine can answer this question"),
        ((Candidate(machine="BM1", total_variation=0.02),), 1e-4, "and no machine is as accurate"),
        ((Candidate(machine="BM1", total_variation=0.01, unfit="too large"),), 1e-4, "no machine can answer"),
    ],
)
def test_the_recommendation(machines, exact, words):
    assert words in _recommendation(machines, exact, 0.01)


def test_a_machine_runs_until_it_is_accurate_enough():
    found = _run_until(lambda setting: (setting**-0.5, 10.0 * setting), 100, 0.01)
    assert 0.008 <= found[1] <= 0.01
    assert found[2] == 10 * found[0]
    assert _run_until(lambda setting: (setting**-0.5, setting), 10**6, 0.01)[0] < 20_000  # fewer are enough
    floor = _run_until(lambda setting: (0.1, 1e6 * setting), 1, 0.01)
    assert floor == (1, 0.1, 1e6)  # never enough, and no more than 3e7 cycles
