"""A run whose peers the test controls."""

from types import SimpleNamespace

import pytest

from services.master.peers import Peer
from services.master.run import Master
from services.settings import Settings
from services.sockets.records import FrameRequest, Reading


class Service:
    """A service at the other end of a peer's connection: it keeps what it is sent."""

    where = "here"

    def __init__(self, peer):
        self.peer = peer
        self.records = []
        self.takes = True
        peer.protocol, peer.ready, peer.greeted = self, True, True

    @property
    def frames(self):
        return [each.number for each in self.records if isinstance(each, FrameRequest)]

    def send(self, record):
        if not self.takes:
            return False
        self.records.append(record)
        return True

    def close(self):
        self.peer.closed.set()


class Run:
    """A master with three services in the test's hands."""

    def __init__(self, boat, *, once=False, count=None, json=False, plot=False, **settings):
        self.master = Master(Settings(**settings), boat, once=once, count=count, json=json, plot=plot)
        self.flow = self.master._flow
        self.peers = self.master._peers
        self.peers._events = self.flow
        self.warnings = []
        self.infos = []
        self.flow._log = SimpleNamespace(
            warning=lambda sentence, **_: self.warnings.append(sentence),
            info=self.infos.append,
            debug=lambda *_, **__: None,
        )
        for role in ("subscriber", "publisher", "pcie-app"):
            self.peers._by_role[role] = Peer(role, None, None)
        self.subscriber = Service(self.peers.subscriber)
        self.publisher = Service(self.peers.publisher)
        self.app = Service(self.peers.app)

    def take(self, service, record):
        self.peers._take(service.peer, record)

    def read(self, count=1, **fields):
        for _ in range(count):
            self.take(
                self.subscriber, Reading(**{"stamp_ns": 0, "received_ns": 0, "received_tick": 0} | fields)
            )

    @property
    def lost(self):
        return self.master.status().frames.lost

    @property
    def error(self):
        return self.flow.end.exception() if self.flow.end.done() else None


@pytest.fixture
async def run(boat):
    """A run that keeps all readings."""
    return Run(boat, queue="all")
