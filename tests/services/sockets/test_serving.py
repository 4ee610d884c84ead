"""A service whose folder was changed behind its back ends when a master asks for what is there now, and only then."""

import asyncio
import shutil

import pytest

from pcie_shim.endpoint import parse_endpoint
from services.errors import OutdatedError
from services.sockets.local_socket import RecordProtocol, open_connection, own_hello
from services.sockets.records import Trouble
from services.sockets.serving import MasterLink, outdated
from tests.integration.conftest import build_boat
from toolchain.building.edits import DeploymentEdits
from toolchain.building.regenerate import regenerate_deployment
from toolchain.deployment import load_deployment


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_boat(tmp_path_factory.mktemp("boat") / "deployment")


@pytest.fixture
def changed(built, tmp_path):
    """A folder's deployment as a service has read it, and as it is now."""
    boat = tmp_path / "boat"
    shutil.copytree(built, boat)
    before = load_deployment(boat)
    regenerate_deployment(boat, DeploymentEdits(target_count=99))
    return before, load_deployment(boat)


def test_only_a_new_start_would_help(changed):
    before, now = changed
    told = outdated(before, own_hello("master", now.hash))
    assert told is not None
    assert str(before.directory) in str(told)
    assert (before.hash[:12] in str(told), now.hash[:12] in str(told)) == (True, True)
    assert outdated(before, own_hello("master", "f" * 64)) is None  # some other master's deployment
    assert outdated(now, own_hello("master", before.hash)) is None  # an older master: the folder is right
    assert outdated(before, own_hello("subscriber", before.hash)) is None
    assert outdated(before, Trouble(2, "no greeting")) is None
    shutil.rmtree(now.directory)
    assert outdated(before, own_hello("master", now.hash)) is None


@pytest.mark.parametrize("asked", ["what is there now", "something else"])
async def test_it_ends(changed, tmp_path, asked):
    before, now = changed
    endpoint = parse_endpoint(f"unix:{tmp_path}/s.sock")
    listens, heard, closed = asyncio.Event(), [], asyncio.Event()

    async def service():
        async with MasterLink(endpoint, "subscriber", before, heard.append):
            listens.set()
            await asyncio.Event().wait()

    async def greet(hash_):
        said = []
        closed.clear()
        protocol = await open_connection(
            endpoint,
            lambda: RecordProtocol(
                "test", lambda _, record: said.append(record), lambda _: None, lambda _, why: closed.set()
            ),
        )
        protocol.send(own_hello("master", hash_))
        await asyncio.wait_for(closed.wait(), 120)
        return said

    serving = asyncio.ensure_future(service())
    await asyncio.wait_for(listens.wait(), 120)
    said = await greet(now.hash if asked == "what is there now" else "f" * 64)
    assert isinstance(said[-1], Trouble)
    if asked == "what is there now":
        with pytest.raises(OutdatedError, match="start this anew"):
            await asyncio.wait_for(serving, 120)
        assert not (tmp_path / "s.sock").exists()
    else:
        await greet("e" * 64)
        assert not serving.done()
        serving.cancel()
    assert heard == []
