"""scripts/verify all: it goes on after a failure, and names what failed."""

from types import SimpleNamespace

from scripts.verifications import all as all_


def test_it_goes_on_after_a_failure(monkeypatch, capsys):
    codes = {"client": 1, "containers": all_.NOT_HERE}
    ran = []

    def run(command, **_):
        ran.append(" ".join(command))
        return SimpleNamespace(returncode=codes.get(command[-1], 0))

    monkeypatch.setattr(all_.subprocess, "run", run)
    assert all_.run(list(all_.PARTS)) == 1
    assert ran == list(all_.PARTS.values())
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == "failed: client"
    assert any(line.startswith("containers: skipped") for line in said)
    assert any(line.startswith("campaign: ok") for line in said)


def test_nothing_fails(monkeypatch):
    monkeypatch.setattr(all_.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    assert all_.run(["client"]) == 0
