"""Peers that start subscriber and publisher for every message: whose turn it is, and what is refused."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from services.errors import SettingsError
from services.master.each_message import EachMessagePeers
from services.settings import Settings
from services.sockets.records import Outcome, Published, Reading, Ready, Seen, Unusable
from terminal.logs import get_logger

READING = Reading(stamp_ns=0, received_ns=0, received_tick=0)


@pytest.fixture
def peers(boat, tmp_path):
    peers = EachMessagePeers(Settings(run_directory=tmp_path), boat, get_logger("test"), once=False)
    peers._events = Mock(is_idle=True)
    peers.prepare()
    for peer in peers:
        peer.child, peer.greeted, peer.ready = SimpleNamespace(terminate=Mock()), True, True
    yield peers
    peers._run.release()


@pytest.mark.parametrize("given", [{"fused": True}, {"subscriber": "unix:/x"}, {"publisher": "unix:/x"}])
def test_services_that_are_not_its_own_are_refused(boat, tmp_path, given):
    peers = EachMessagePeers(Settings(run_directory=tmp_path, **given), boat, get_logger("test"), once=False)
    with pytest.raises(SettingsError, match="--start-each-message"):
        peers.prepare()
    peers._run.release()


@pytest.mark.parametrize("record", [READING, Unusable("", "")])
def test_a_subscriber_ends_with_its_message_and_a_second_one_does_not_count(peers, record):
    subscriber = peers.subscriber
    peers._take(subscriber, record)
    peers._take(subscriber, READING)
    subscriber.child.terminate.assert_called_once()
    peers._events.received.assert_called_once_with(subscriber, record)
    assert peers._awaited(subscriber).limit == Settings().stop_timeout


@pytest.mark.parametrize("outcome", list(Outcome))
def test_a_publisher_ends_once_its_result_was_looked_for(peers, outcome):
    publisher = peers.publisher
    peers._take(publisher, Published(1, outcome, None, 0, 0.0, 0, 0))
    assert publisher.child.terminate.called is (outcome is not Outcome.PUBLISHED)
    peers._take(publisher, Seen(False))
    publisher.child.terminate.assert_called_once()
    # not before its publisher has ended is it the turn of the next message
    assert not peers._is_its_turn(peers.subscriber)


def test_turns(peers):
    """The first publisher has nothing to publish: it ends when the run begins."""
    for peer in peers:
        peers._take(peer, Ready(""))
    assert peers._done == {peers.publisher}
    peers._done.clear()
    assert peers._is_its_turn(peers.subscriber)
    assert not peers._is_its_turn(peers.publisher)
    peers._take(peers.subscriber, READING)
    peers._events.is_idle = False
    assert not peers._is_its_turn(peers.subscriber)
    assert not peers._is_its_turn(peers.publisher)  # before the subscriber has ended
    peers._done.clear()
    assert peers._is_its_turn(peers.publisher)
