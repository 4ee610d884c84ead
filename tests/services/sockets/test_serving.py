"""A service whose folder was changed ends when a master asks for the new deployment, and only then."""

import asyncio
import shutil

import pytest

from pcie_shim.endpoint import parse_endpoint
from services.errors import OutdatedError
from services.sockets import serving
from services.sockets.local_socket import RecordProtocol, open_connection, own_hello
from services.sockets.records import Hello, Notice, Trouble
from services.sockets.serving import MasterLink, outdated
from tests.patience import PATIENCE
from tests.services.conftest import until
from toolchain.building.options import DeploymentEdits
from toolchain.building.regenerate import regenerate_deployment
from toolchain.deployment import load_deployment


@pytest.fixture
def changed(built, tmp_path):
    """A folder's deployment as a service has read it, and as it is now."""
    boat = tmp_path / "boat"
    shutil.copytree(built, boat)
    before = load_deployment(boat)
    regenerate_deployment(boat, DeploymentEdits(target_count=99))
    return before, load_deployment(boat)


def test_only_a_restart_would_help(changed):
    before, now = changed
    assert isinstance(outdated(before, own_hello("master", now.hash)), OutdatedError)
    assert outdated(before, own_hello("master", "f" * 64)) is None  # some other master's deployment
    assert outdated(now, own_hello("master", before.hash)) is None  # an older master: the folder is right
    assert outdated(before, own_hello("subscriber", before.hash)) is None
    assert outdated(before, Trouble(2, "no greeting")) is None
    shutil.rmtree(now.directory)
    assert outdated(before, own_hello("master", now.hash)) is None


class Served:
    """A service behind a local socket, and masters that connect to it."""

    def __init__(self, endpoint, deployment):
        self.endpoint = endpoint
        self.records = []
        self.link = MasterLink(endpoint, "subscriber", deployment, self.records.append)
        self.listens = asyncio.Event()
        self.task = asyncio.ensure_future(self._serve())

    async def _serve(self):
        async with self.link:
            self.listens.set()
            await asyncio.Event().wait()

    async def connect(self, hash_=None):
        """A master's connection, its records, and an event of its end; without a hash it does not greet."""
        await asyncio.wait_for(self.listens.wait(), PATIENCE)
        records, closed = [], asyncio.Event()
        protocol = await open_connection(
            self.endpoint,
            lambda: RecordProtocol(
                "test", lambda _, record: records.append(record), lambda _: None, lambda _, why: closed.set()
            ),
        )
        if hash_ is not None:
            protocol.send(own_hello("master", hash_))
        return protocol, records, closed


@pytest.fixture
async def serve(tmp_path):
    made = []

    def serve(deployment):
        made.append(Served(parse_endpoint(f"unix:{tmp_path}/s.sock"), deployment))
        return made[-1]

    yield serve
    for each in made:
        each.task.cancel()
        await asyncio.wait([each.task])


@pytest.mark.parametrize("asks_for_new", [True, False])
async def test_a_service_ends_if_a_restart_helps(changed, serve, asks_for_new):
    before, now = changed
    service = serve(before)
    for hash_ in (now.hash,) if asks_for_new else ("f" * 64, "e" * 64):
        _, records, closed = await service.connect(hash_)
        await asyncio.wait_for(closed.wait(), PATIENCE)
        assert isinstance(records[-1], Trouble)
    if asks_for_new:
        with pytest.raises(OutdatedError):
            await asyncio.wait_for(service.task, PATIENCE)
    assert service.task.done() is asks_for_new
    assert service.records == []


async def test_one_master_is_served_at_a_time(changed, serve):
    now = changed[1]
    service = serve(now)
    service.link.keep(Notice("info", "state"))
    first, records, closed = await service.connect(now.hash)
    _, refused, refused_closed = await service.connect(now.hash)
    await asyncio.wait_for(refused_closed.wait(), PATIENCE)
    assert [type(each) for each in refused] == [Trouble]
    assert service.link.has_master
    assert service.link.send(Notice("info", "more"))
    await until(lambda: len(records) == 3)
    assert [type(each) for each in records] == [Hello, Notice, Notice]
    first.close()
    await asyncio.wait_for(closed.wait(), PATIENCE)
    await until(lambda: not service.link.has_master)
    assert not service.link.send(Notice("info", "lost"))
    _, records, _ = await service.connect(now.hash)
    await until(lambda: len(records) == 2)
    assert records[1].sentence == "state"
    assert service.records == []  # a greeting is the link's
    assert service.link.masters == 2


async def test_what_a_service_says_before_its_master_comes_is_not_lost(changed, serve):
    service = serve(changed[1])
    for number in range(serving.MAX_UNSAID + 1):
        service.link.notice("info", str(number))
    for expected in (["1", "2", "3", "4", "now"], ["now"]):
        protocol, records, _ = await service.connect(changed[1].hash)
        await until(lambda: service.link.has_master)
        service.link.notice("info", "now")
        await until(lambda records=records, expected=expected: len(records) == len(expected) + 1)
        assert [each.sentence for each in records[1:]] == expected
        protocol.close()
        await until(lambda: not service.link.has_master)


async def test_a_client_that_does_not_greet_is_cut_off(changed, serve, monkeypatch):
    monkeypatch.setattr(serving, "GREETING_TIME", 0.1)
    service = serve(changed[1])
    _, _, closed = await service.connect()
    await asyncio.wait_for(closed.wait(), PATIENCE)
    assert not service.link.has_master
