"""Peers: how long the master waits for its own processes and for others, and which peers it accepts."""

import asyncio
import time
from contextlib import nullcontext, suppress
from types import SimpleNamespace
from unittest.mock import AsyncMock, Mock

import pytest

from services.child import RESTARTS, Child
from services.errors import BoardFailedError, ChildDiedError, ReportedError, SettingsError
from services.master.peers import Awaited, Peer, Peers
from services.settings import Settings
from services.sockets.local_socket import open_connection, own_hello
from services.sockets.records import Begin, Ready, Trouble
from services.sockets.serving import endpoint_from
from terminal.logs import get_logger
from tests.patience import PATIENCE, PROCESS_PATIENCE


@pytest.fixture
def events():
    """A run that only notes what happens."""
    events = Mock(error=None, pending=None)
    events.awaited.side_effect = lambda _peer: events.pending
    events.fail.side_effect = lambda error: setattr(events, "error", error)
    return events


@pytest.fixture
def peers(boat, tmp_path, events):
    peers = Peers(Settings(peer_timeout=0.2), boat, get_logger("test"), once=True)
    peers._events = events
    return peers


@pytest.mark.parametrize("own", [True, False])
async def test_a_process_may_start_slowly_but_not_for_ever(peers, tmp_path, monkeypatch, own):
    refused = asyncio.Event()

    async def connect(*arguments):
        try:
            return await open_connection(*arguments)
        except OSError:
            refused.set()
            raise

    monkeypatch.setattr("services.master.peers.open_connection", connect)
    place = tmp_path / "late.sock"
    child = SimpleNamespace(is_running=True) if own else None
    peer = Peer("subscriber", endpoint_from(f"unix:{place}", "here"), child)
    with pytest.raises(ChildDiedError, match=r"overloaded\?$" if own else r"running\?$"):
        await peers._connect(peer, 0.05)  # nothing listens there
    refused.clear()
    connecting = asyncio.ensure_future(peers._connect(peer, PATIENCE))
    await asyncio.wait_for(refused.wait(), PATIENCE)
    accepted = asyncio.Event()
    async with await asyncio.start_unix_server(lambda _, writer: (writer.close(), accepted.set()), place):
        await asyncio.wait_for(connecting, PATIENCE)
        await asyncio.wait_for(accepted.wait(), PATIENCE)
        await asyncio.wait_for(peer.closed.wait(), PATIENCE)


@pytest.mark.process
async def test_a_process_that_dies_is_restarted_three_times(boat, tmp_path):
    peers = Peers(Settings(restart_window=PROCESS_PATIENCE), boat, get_logger("test"), once=False)
    boards = Child("the boards' process", ["/bin/sh", "-c", f"echo >> {tmp_path}/starts; kill -KILL $$"])
    await boards.start()
    with pytest.raises(BoardFailedError, match="SIGKILL"):
        await asyncio.wait_for(peers._keep_boards(boards), PROCESS_PATIENCE)
    boards.close()
    assert (tmp_path / "starts").read_text() == "\n" * (1 + RESTARTS)


@pytest.mark.process
@pytest.mark.parametrize("once", [True, False])
async def test_a_process_that_dies_before_it_is_connected_is_restarted(boat, tmp_path, once):
    place = tmp_path / "x.sock"
    peers = Peers(Settings(), boat, get_logger("test"), once=once)
    child = Child(
        "subscriber",
        ["/bin/sh", "-c", f"[ -e {tmp_path}/again ] && exec sleep 1000; >{tmp_path}/again; kill -KILL $$"],
    )
    await child.start()
    await child.wait()
    connecting = asyncio.ensure_future(
        peers._connect(Peer("subscriber", endpoint_from(f"unix:{place}", "here"), child), PATIENCE)
    )
    if once:
        with pytest.raises(ReportedError, match="SIGKILL"):
            await connecting
    else:
        async with await asyncio.start_unix_server(lambda _, writer: writer.close(), place):
            await asyncio.wait_for(connecting, PATIENCE)
        assert child.is_running
    child.kill()
    await child.wait()
    child.close()


class Process:
    """A process of the master's own."""

    def __init__(self):
        self.killed = asyncio.Event()
        self.kill = self.killed.set


@pytest.mark.parametrize("own", [True, False])
async def test_a_peer_that_does_not_answer_in_time_is_cut_off(peers, events, own):
    process = Process()
    peers._once = False
    peer = Peer("pcie-app", endpoint_from("unix:/x", ""), process if own else None)
    peer.greeted = peer.ready = True
    peer.protocol = SimpleNamespace(close=process.kill)
    events.pending = Awaited("answer frame 3", time.monotonic(), 0.05)
    watching = asyncio.ensure_future(peers._watch(peer))
    await asyncio.wait_for(process.killed.wait(), PATIENCE)
    assert isinstance(events.error, ChildDiedError) is not own
    peer.closed.set()
    await asyncio.wait_for(watching, PATIENCE)


@pytest.mark.parametrize(("own_boards", "ready"), [(False, 10.8), (True, 70.8)])
async def test_boards_that_compile_give_services_more_time(peers, events, own_boards, ready):
    peer = Peer("pcie-app", endpoint_from("unix:/x", ""), None)
    peer.since = 7.0
    peers._boards = Process() if own_boards else None
    assert peers._service_settings.peer_timeout == pytest.approx(ready - 10.6)  # for the boards
    events.pending = Awaited("answer frame 3", 1.0, 0.2)
    for limit in (0.2, ready):
        awaited = peers._awaited(peer)
        assert (awaited.since, awaited.limit) == (7.0, pytest.approx(limit))
        peer.greeted, peer.ready = True, peer.greeted
    assert peers._awaited(peer) is events.pending


ROLES = ("subscriber", "publisher", "pcie-app")


def prepared(boat, directory, **settings):
    """Peers that are known, and not started; their directory is free again."""
    peers = Peers(Settings(run_directory=directory, **settings), boat, get_logger("test"), once=True)
    try:
        peers.prepare()
    finally:
        if peers._run is not None:
            peers._run.release()
    return peers


@pytest.mark.parametrize("given", [(), ("publisher",), ("pcie-app",), ROLES])
def test_peers_that_are_not_given_are_started(boat, tmp_path, given):
    peers = prepared(boat, tmp_path, **{role.replace("-", "_"): f"unix:/tmp/{role}.sock" for role in given})
    assert [peer.role for peer in peers] == list(ROLES)
    assert tuple(peer.role for peer in peers if peer.child is None) == given
    assert (peers.directory is None) is (given == ROLES)
    assert (peers._boards is None) is ("pcie-app" in given)
    places = {endpoint_from(each, "").path for each in peers.board_endpoints}  # each board has its own
    assert len(places) == (0 if "pcie-app" in given else len(boat.boards))


@pytest.mark.parametrize("given", [{}, {"publisher": "unix:/tmp/publisher.sock"}])
def test_a_fused_master_has_all_services_inside(boat, tmp_path, given):
    with pytest.raises(SettingsError) if given else nullcontext():
        peers = prepared(boat, tmp_path, fused=True, boards=("unix:/tmp/board.sock",) * 4, **given)
        assert [(peer.endpoint, peer.child) for peer in peers] == [(None, None)] * 3


@pytest.mark.parametrize("given", [{"link_rate": "jtag"}, {"read_results": True}])
@pytest.mark.parametrize(
    "where", [{}, {"boards": ("tcp://10.0.0.2:7000",) * 4}, {"pcie_app": "unix:/tmp/a.sock"}]
)
def test_flags_of_boards_that_are_started_elsewhere_are_refused(boat, tmp_path, given, where):
    with pytest.raises(SettingsError, match="board") if where else nullcontext():
        prepared(boat, tmp_path, **given, **where)


@pytest.fixture
def connected(peers):
    """A service of the master's own that has just connected."""
    peer = peers._by_role["publisher"] = Peer("publisher", None, None)
    peer.child, peer.since = Process(), time.monotonic()
    return peer


@pytest.mark.parametrize("last", ROLES)
async def test_the_subscriber_begins_when_all_are_ready(peers, events, last):
    order = []
    for role in ROLES:
        peer = peers._by_role[role] = Peer(role, None, None)
        peer.greeted = True
        peer.protocol = SimpleNamespace(send=lambda record, role=role: order.append((role, record)))
    for role in sorted(ROLES, key=lambda role: role == last):
        assert not peers.begun.is_set()
        assert order == []
        peers._take(peers._by_role[role], Ready("here"))
    assert peers.begun.is_set()
    assert order == [("subscriber", Begin(once=True)), ("publisher", Begin(once=True))]
    peers._take(peers.subscriber, Ready("again"))  # after a restart
    assert order[2:] == [("subscriber", Begin(once=True))]


async def test_trouble_and_an_error_in_taking_a_record_end_the_run(peers, events, connected):
    peers._take(connected, Trouble(4, "no luck"))
    assert isinstance(events.error, ReportedError)
    assert events.error.exit_code == 4
    connected.greeted = True
    events.received = Mock(side_effect=BrokenPipeError)
    peers._take(connected, Begin(once=False))
    assert isinstance(events.error, BrokenPipeError)


async def test_only_the_end_of_the_present_connection_counts(peers, connected):
    connected.protocol = object()
    peers._closed(connected, object(), None)
    assert not connected.closed.is_set()
    peers._closed(connected, connected.protocol, reason := OSError())
    assert connected.closed.is_set()
    assert connected.reason is reason


async def test_a_peer_that_is_gone_is_reported_once(peers, connected, boat):
    connected.child, peers._once, peers._log = None, False, Mock()
    for _ in range(2):
        for _ in range(2):
            await peers._bring_back(connected)
        peers._take(connected, own_hello("publisher", boat.hash))
        connected.greeted = False
    assert peers._log.warning.call_count == 2  # once each time


@pytest.mark.parametrize(("own", "limit"), [(True, 60.0), (False, 0.2)])
async def test_a_lost_peer_is_brought_back(peers, connected, own, limit):
    if not own:
        connected.child = None
    peers._connect, peers._watch = AsyncMock(), AsyncMock()
    peers._bring_back = AsyncMock(side_effect=[None, ChildDiedError("it died")])
    connected.protocol, connected.ready, connected.away = object(), True, True
    with pytest.raises(ChildDiedError):
        await peers._keep(connected)
    assert (connected.protocol, connected.ready, connected.away) == (None, False, False)
    assert [each.args for each in peers._connect.await_args_list] == [(connected, limit), (connected, 60.0)]


async def test_services_inside_get_a_grace_period_to_end(boat, tmp_path):
    async def stubborn():
        while True:
            with suppress(asyncio.CancelledError):
                await stopped.wait()
                return

    stopped = asyncio.Event()
    peers = Peers(Settings(stop_timeout=0.1), boat, get_logger("test"), once=True)
    task = asyncio.ensure_future(stubborn())
    peers._inside.append(task)
    await asyncio.sleep(0)
    await asyncio.wait_for(peers.leave(), PATIENCE)
    assert not task.done()
    stopped.set()
    await task


async def test_the_status_of_a_peer_that_is_not_a_child(peers, connected):
    connected.child = None
    (status,) = peers.status()
    assert (status.name, status.pid, status.restarts, status.ready) == ("publisher", 0, 0, False)
    connected.child, connected.ready = Mock(pid=7, restarts=2), True
    (status,) = peers.status()
    assert (status.pid, status.restarts, status.ready) == (7, 2, True)
