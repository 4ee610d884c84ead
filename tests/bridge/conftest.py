"""The client must live on either event loop: every asynchronous test of it runs on both, on uvloop with `--all`."""

import asyncio
from collections.abc import Callable, Mapping

import pytest
import uvloop


def pytest_asyncio_loop_factories() -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


@pytest.fixture(params=[True, False], ids=["quick frames", "library alone"])
def either_reader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the test with the quick path for whole frames, and with the library reading and writing all of them."""
    monkeypatch.setattr("bridge.transport.websocket.QUICK_FRAMES", request.param)
