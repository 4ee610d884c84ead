"""The status sockets of the case studies' processes, asked as a health check asks them."""

import asyncio
import json
import re

import pytest

from casestudies import publishing as module
from casestudies.publishing import Readiness, serve_readiness
from terminal.health import is_ready, read_status, status_socket
from tests.patience import PATIENCE

WORK = "a result was shown"


@pytest.fixture
async def readiness(tmp_path, monkeypatch):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    readiness = Readiness(WORK)
    async with serve_readiness("boat-viewer", readiness):
        yield readiness


async def asked(directory):
    return await asyncio.to_thread(is_ready, status_socket(directory, "boat-viewer"), PATIENCE)


async def test_ready_once_it_has_worked(tmp_path, readiness, monkeypatch):
    monkeypatch.setattr(module, "RECENT_S", PATIENCE)
    ready, why = await asked(tmp_path)
    assert not ready
    assert why.endswith(WORK)
    readiness.record()
    ready, why = await asked(tmp_path)
    assert ready
    assert re.fullmatch(WORK + r" [\d.]+ s ago, 1 in all", why)


async def test_not_ready_when_its_work_stopped(tmp_path, readiness, monkeypatch):
    monkeypatch.setattr(module, "RECENT_S", 0.0)
    readiness.record()
    await asyncio.sleep(0.01)
    assert not (await asked(tmp_path))[0]


async def test_is_a_status_of_the_stack(tmp_path, readiness):
    path = status_socket(tmp_path, "boat-viewer")
    status = json.loads(await asyncio.to_thread(read_status, path, PATIENCE))
    assert (status["name"], status["ready"]) == ("boat-viewer", False)
    assert status["pid"] > 0


@pytest.mark.parametrize("directory", ["", "missing"])
async def test_works_without_a_place_for_it(tmp_path, monkeypatch, capsys, directory):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path / directory) if directory else "")
    async with serve_readiness("boat-simulator", Readiness(WORK)):
        pass
    assert ("boat-simulator: warning: " in capsys.readouterr().err) is bool(directory)
