"""scripts/test: which failures are forgiven."""

import pytest

from scripts.running import tests

PASSED, ODD = (0, []), (2, [])
"""A run of pytest that passed, and one in which no test failed, but pytest itself."""
FLAKY = (1, ["a", "b"])


@pytest.mark.parametrize(
    ("outcomes", "code", "said"),
    [
        ([PASSED, PASSED], 0, []),
        ([(1, ["a"]), PASSED], 1, ["FAILED a"]),  # a test without processes is not run again
        ([PASSED, FLAKY, PASSED], 0, ["FLAKY a", "FLAKY b"]),
        ([PASSED, FLAKY, (1, ["b"])], 1, ["FLAKY a", "FAILED b"]),
        ([PASSED, (1, ["a", "b", "c"]), PASSED], 1, ["FAILED a", "FAILED b", "FAILED c"]),
        ([ODD, PASSED], 1, ["FAILED pytest, with exit code 2"]),
        ([PASSED, ODD], 1, ["FAILED pytest, with exit code 2"]),
    ],
)
def test_what_is_run_again_and_what_fails(outcomes, code, said, monkeypatch, capsys):
    left, runs = list(outcomes), []

    def pytest_(*arguments):
        runs.append(arguments)
        return left.pop(0)

    monkeypatch.setattr(tests, "pytest", pytest_)
    monkeypatch.setattr("sys.argv", ["tests"])
    assert tests.main() == code
    assert not left
    assert [run[1] for run in runs[:2]] == ["not process and not thorough", "process and not thorough"]
    assert all(run == ("a", "b") for run in runs[2:] if len(said) < 3)
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith(("FLAKY", "FAILED"))][-len(said) or 99 :] == said
