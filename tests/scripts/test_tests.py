"""scripts/test: which failures it forgives."""

import pytest

from scripts.running import tests

PASSED = 0, []


@pytest.fixture
def outcome(monkeypatch, capsys):
    """Return a function from what each run of pytest says to the exit code, the last lines, and the runs."""

    def judge(*outcomes, flags=()):
        runs, left = [], list(outcomes)

        def pytest_(*arguments):
            runs.append(arguments)
            return left.pop(0)

        monkeypatch.setattr(tests, "pytest", pytest_)
        monkeypatch.setattr("sys.argv", ["tests", *flags])
        code = tests.main()
        assert not left
        return (
            code,
            [line for line in capsys.readouterr().out.splitlines() if not line.startswith("--")],
            runs,
        )

    return judge


def test_all_pass(outcome):
    code, lines, runs = outcome(PASSED, PASSED)
    assert (code, lines) == (0, [])
    assert [run[1] for run in runs] == ["not process and not thorough", "process and not thorough"]


def test_thorough_tests_only_with_all(outcome):
    _, _, runs = outcome(PASSED, PASSED, PASSED, flags=["--all"])
    assert runs[-1][1] == "thorough"


def test_a_test_without_processes_is_not_run_again(outcome):
    assert outcome((1, ["a::b"]), PASSED)[:2] == (1, ["FAILED a::b"])


def test_a_test_with_processes_is_run_again_and_listed(outcome):
    code, lines, runs = outcome(PASSED, (1, ["a::b", "a::c"]), PASSED)
    assert (code, lines) == (0, ["FLAKY a::b", "FLAKY a::c"])
    assert runs[-1] == ("a::b", "a::c")


def test_a_test_that_fails_twice_fails(outcome):
    code, lines, _ = outcome(PASSED, (1, ["a::b", "a::c"]), (1, ["a::c"]))
    assert (code, lines) == (1, ["FLAKY a::b", "FAILED a::c"])


def test_three_flaky_tests_are_too_many(outcome):
    code, lines, _ = outcome(PASSED, (1, ["a", "b", "c"]), PASSED)
    assert code == 1
    assert lines[-3:] == ["FAILED a", "FAILED b", "FAILED c"]


@pytest.mark.parametrize("at", [0, 1])
def test_what_is_no_test_is_named(outcome, at):
    outcomes = [PASSED, PASSED]
    outcomes[at] = 2, []
    assert outcome(*outcomes)[:2] == (1, ["FAILED pytest, with exit code 2"])
