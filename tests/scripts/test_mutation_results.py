"""The file of results of mutants: what an interrupted run leaves of it can be continued."""

import json

import pytest

from scripts.mutation import campaign

RESULT = {
    "module": "bridge/client/session.py",
    "digest": "ab",
    "line": 3,
    "before": "a",
    "after": "b",
    "outcome": "found",
    "tests": 7,
    "seconds": 1.5,
}


@pytest.mark.parametrize(
    "damaged", [b'{"module": "bridge', b"{}", b"[1]", b'{"module": "\xff"}', b"null", b"[" * 10_000], ids=str
)
def test_a_damaged_line_is_reported_and_left_out(tmp_path, monkeypatch, capsys, damaged):
    results = tmp_path / "results.jsonl"
    monkeypatch.setattr(campaign, "RESULTS", results)
    assert campaign.known_results() == {}
    results.write_bytes(json.dumps(RESULT).encode() + b"\n" + damaged)
    assert campaign.known_results() == {("bridge/client/session.py", "ab"): campaign.Result(**RESULT)}
    assert f"{results}:2 " in capsys.readouterr().err
    campaign.end_last_line()
    with results.open("a") as file:
        file.write(json.dumps(RESULT | {"digest": "cd"}) + "\n")
    assert [digest for _, digest in campaign.known_results()] == ["ab", "cd"]


def test_the_last_line_is_completed_once(tmp_path, monkeypatch):
    results = tmp_path / "new" / "results.jsonl"
    monkeypatch.setattr(campaign, "RESULTS", results)
    campaign.end_last_line()
    assert results.read_bytes() == b""
    results.write_bytes(b"{}")
    for _ in range(2):
        campaign.end_last_line()
        assert results.read_bytes() == b"{}\n"
