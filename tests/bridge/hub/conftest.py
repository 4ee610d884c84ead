import pytest

from bridge.hub import server


@pytest.fixture
def quick_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Silent and stuck clients are looked for often, so that limits of tenths of a second can be tested."""
    monkeypatch.setattr(server, "_SWEEP", 0.02)
    monkeypatch.setattr(server, "_CLOSE_TIMEOUT", 0.3)
