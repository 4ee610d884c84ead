"""How long the master waits for those that it started itself, and for others."""

import asyncio
import sys
import time

import pytest

from services.errors import ChildDiedError
from services.master.peers import Peer, Peers
from services.pipeline.generations import InForce
from services.settings import Settings
from services.sockets.serving import endpoint_from
from services.supervision.child import Child
from terminal.logs import get_logger
from tests.integration.conftest import build_boat
from toolchain.deployment import load_deployment

LATE = """
import socket, sys, time
time.sleep(2)
with socket.socket(socket.AF_UNIX) as listener:
    listener.bind(sys.argv[1])
    listener.listen()
    listener.accept()
    time.sleep(60)
"""


class Run:
    """What hears of the peers' ends, and waits for nobody."""

    def __init__(self):
        self.error = None

    def take(self, peer, record): ...

    def lost(self, peer): ...

    def awaited(self, peer):
        return None

    def fail(self, error):
        self.error = error


@pytest.mark.parametrize("own", [True, False])
async def test_a_process_of_its_own_may_start_slowly(tmp_path, own):
    deployment = load_deployment(build_boat(tmp_path / "deployment"))
    run = Run()
    peers = Peers(
        Settings(peer_timeout=0.2), InForce(deployment, tmp_path), run, get_logger("test"), once=True
    )
    place = tmp_path / "late.sock"
    child = Child("subscriber", [sys.executable, "-c", LATE, str(place)])
    await child.start()
    peer = Peer("subscriber", endpoint_from(f"unix:{place}", "here"), child if own else None)
    keeping = asyncio.ensure_future(peers._keep(peer))
    try:
        deadline = time.monotonic() + 50
        while peer.protocol is None and run.error is None:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.02)
        # one that is there and then says nothing for as long is another matter
        not_there = isinstance(run.error, ChildDiedError) and "no subscriber answers" in str(run.error)
        assert not_there is not own
    finally:
        keeping.cancel()
        await asyncio.wait([keeping])
        if peer.protocol is not None:
            peer.protocol.close()
        child.kill()
        await child.ended()
        child.close()
