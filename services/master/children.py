"""Liveness checks of the master's children."""

import asyncio
import time
from collections.abc import Iterable
from pathlib import Path

from services.master.peers import Peer
from services.sockets.reporting import STUCK_S
from services.sockets.status import read_process_status
from terminal.health import NoHealthError, status_socket

ASK_EVERY = 5.0
"""Seconds between two questions to all children."""
_ANSWER_TIME = 2.0


class ChildrenWatch:
    """The progress of the processes that a master started, according to their status sockets.

    A child that is being restarted does not count: the master knows of it. One that is stopped or stuck
    while nothing is expected of it would otherwise go unnoticed.
    """

    def __init__(self, peers: Iterable[Peer], directory: Path) -> None:
        """Take the services of the master, and the directory of their sockets."""
        self._peers = peers
        self._directory = directory
        self._answered = time.monotonic()

    def is_alive(self) -> bool:
        """Return whether all of them have answered recently."""
        return time.monotonic() - self._answered < STUCK_S

    async def run(self) -> None:
        """Ask until cancelled."""
        while True:
            running = [peer.role for peer in self._peers if peer.child is not None and peer.child.is_running]
            if all(await asyncio.gather(*map(self._is_well, running))):
                self._answered = time.monotonic()
            await asyncio.sleep(ASK_EVERY)

    async def _is_well(self, role: str) -> bool:
        try:
            return (await read_process_status(status_socket(self._directory, role), _ANSWER_TIME)).alive
        except NoHealthError:
            return False
