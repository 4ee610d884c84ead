"""The status sockets of the case studies' processes, asked as a health check asks them."""

import asyncio
import json
import re

import pytest

from casestudies import readiness as module
from casestudies.readiness import Readiness, readiness_told
from services.ready import ask


async def asked(directory, name="boat-viewer"):
    return await asyncio.to_thread(ask, str(directory), name, 30)


async def test_ready_once_it_has_worked(tmp_path, monkeypatch):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    readiness = Readiness("a result was shown")
    async with readiness_told("boat-viewer", readiness):
        assert await asked(tmp_path) == (False, "boat-viewer: not once yet: a result was shown")
        readiness.did()
        ready, why = await asked(tmp_path)
        assert ready
        assert re.fullmatch(r"boat-viewer: a result was shown [\d.]+ s ago, 1 in all", why)
    ready, why = await asked(tmp_path)
    assert not ready
    assert "not running" in why
    assert not list(tmp_path.iterdir())


async def test_not_ready_when_its_work_stopped(tmp_path, monkeypatch):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    monkeypatch.setattr(module, "RECENT_S", 0.0)
    readiness = Readiness("a result was shown")
    async with readiness_told("boat-viewer", readiness):
        readiness.did()
        await asyncio.sleep(0.01)
        assert not (await asked(tmp_path))[0]


async def test_takes_over_from_one_that_was_killed(tmp_path, monkeypatch):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    left = tmp_path / "boat-viewer.status.sock"
    server = await asyncio.start_unix_server(lambda *_: None, left)
    server.close()
    left.touch()
    readiness = Readiness("a result was shown")
    readiness.did()
    async with readiness_told("boat-viewer", readiness):
        assert (await asked(tmp_path))[0]
        assert left.stat().st_mode & 0o777 == 0o600


async def test_is_a_status_of_the_stack(tmp_path, monkeypatch):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    async with readiness_told("boat-simulator", Readiness("a reading was published")):
        reader, writer = await asyncio.open_unix_connection(tmp_path / "boat-simulator.status.sock")
        told = json.loads(await reader.read())
        writer.close()
    assert told["name"] == "boat-simulator"
    assert not told["ready"]
    assert told["pid"] > 0


@pytest.mark.parametrize("directory", ["", "missing"])
async def test_works_without_a_place_for_it(tmp_path, monkeypatch, capsys, directory):
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path / directory) if directory else "")
    async with readiness_told("boat-simulator", Readiness("a reading was published")):
        pass
    assert ("can't be shown" in capsys.readouterr().err) is bool(directory)
