"""Peers: how long the master waits for its own processes and for others, and whom it takes for a peer."""

import asyncio
import sys
import time
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from services.errors import ChildDiedError, OtherPeerError, ReportedError
from services.master.peers import Awaited, Peer, Peers
from services.pipeline.generations import InForce
from services.settings import Settings
from services.sockets.local_socket import own_hello
from services.sockets.records import Begin, Ready, Trouble
from services.sockets.serving import endpoint_from
from services.supervision.child import Child
from terminal.logs import get_logger

LATE = """
import socket, sys, time
time.sleep(1)
with socket.socket(socket.AF_UNIX) as listener:
    listener.bind(sys.argv[1])
    listener.listen()
    listener.accept()
    time.sleep(60)
"""


class Events:
    """A run that only notes what happens."""

    def __init__(self):
        self.error = self.pending = None

    def ready(self, peer): ...

    def received(self, peer, record): ...

    def lost(self, peer): ...

    def awaited(self, peer):
        return self.pending

    def fail(self, error):
        self.error = error


@pytest.fixture
def events():
    return Events()


@pytest.fixture
def peers(boat, tmp_path, events):
    peers = Peers(Settings(peer_timeout=0.2), InForce(boat, tmp_path), get_logger("test"), once=True)
    peers._events = events
    return peers


@pytest.mark.parametrize("own", [True, False])
async def test_a_process_of_its_own_may_start_slowly(peers, events, tmp_path, own):
    place = tmp_path / "late.sock"
    child = Child("subscriber", [sys.executable, "-c", LATE, str(place)])
    await child.start()
    peer = Peer("subscriber", endpoint_from(f"unix:{place}", "here"), child if own else None)
    connecting = asyncio.ensure_future(peers._connect(peer, 50 if own else 0.2))
    try:
        await asyncio.wait([connecting], timeout=50)
        assert isinstance(connecting.exception(), ChildDiedError) is not own
    finally:
        if peer.protocol is not None:
            peer.protocol.close()
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
    events.pending = Awaited("answer frame 3", time.monotonic(), 0.2)
    watching = asyncio.ensure_future(peers._watch(peer))
    await asyncio.wait_for(process.killed.wait(), 50)
    assert isinstance(events.error, ChildDiedError) is not own
    peer.closed.set()
    await asyncio.wait_for(watching, 50)


@pytest.fixture
def connected(peers):
    """A service of the master's own that has just connected."""
    peer = peers._by_role["publisher"] = Peer("publisher", None, None)
    peer.child, peer.since = Process(), time.monotonic()
    return peer


async def test_a_child_that_was_started_before_a_reload_is_restarted(peers, events, connected, boat):
    in_force = peers._in_force
    in_force.former_hash, in_force.generation = "f" * 64, 1
    peers._take(connected, own_hello("publisher", in_force.former_hash))
    assert (connected.outdated, connected.greeted, connected.child.killed.is_set()) == (True, False, True)
    peers._take(connected, Ready("publishing"))
    assert not connected.ready
    # and its successor is taken
    connected.outdated = False
    connected.child.killed.clear()
    peers._take(connected, own_hello("publisher", boat.hash))
    assert (connected.greeted, connected.generation, connected.child.killed.is_set()) == (True, 1, False)
    assert events.error is None


@pytest.mark.parametrize("case", ["not a child", "same deployment again", "third deployment"])
async def test_only_a_child_of_the_former_deployment_is_restarted(peers, connected, boat, case):
    peers._in_force.former_hash = boat.hash if case == "same deployment again" else "f" * 64
    hash_ = "e" * 64 if case == "third deployment" else peers._in_force.former_hash
    child = connected.child
    if case == "not a child":
        connected.child = None
    if case == "same deployment again":
        peers._take(connected, own_hello("publisher", hash_))
        assert connected.greeted
    else:
        with pytest.raises(OtherPeerError):
            peers._take(connected, own_hello("publisher", hash_))
    assert not child.killed.is_set()


async def test_the_subscriber_begins_when_all_are_ready(peers, events):
    order = []
    for role in ("subscriber", "publisher", "pcie-app"):
        peer = peers._by_role[role] = Peer(role, None, None)
        peer.greeted = True
        peer.protocol = SimpleNamespace(send=lambda record, role=role: order.append((role, record)))
    for role in ("subscriber", "pcie-app", "publisher"):
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
