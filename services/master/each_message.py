"""A run that starts subscriber and publisher again for every message, as the thesis probably did (3.1, 3.3).

    subscriber starts ─▶ a reading ─▶ it ends ─▶ publisher starts ─▶ pcie-app ─▶ a result ─▶ it ends ─▶ subscriber ...

The time from one result to the next includes both starts. pcie-app and the boards run all the time. The first
publisher only checks whether the server accepts the topics, and ends when the run begins.
"""

import asyncio
import time

from services.errors import SettingsError
from services.master.peers import Awaited, Peer, Peers
from services.settings import LONGEST_S, Settings
from services.sockets.records import AnyRecord, Outcome, Published, Reading, Ready, Seen, Unusable


class EachMessagePeers(Peers):
    """The three services of a run. For each message, a new subscriber and a new publisher are started."""

    # Peers that have done their work and were told to end, until they have ended. Their records are ignored: another
    # reading arrived together with the one that was taken, and is missed as if nobody had subscribed.
    _done: set[Peer]
    # True from the outcome of a result until its publisher has ended.
    _publishing: bool
    # Set whenever a service that waits for its turn may go on; a service that must still wait clears it.
    _changed: asyncio.Event

    def prepare(self) -> None:
        """Determine the peers. Raises a SettingsError unless the master itself starts both subscriber and publisher."""
        self._done, self._publishing, self._changed = set(), False, asyncio.Event()
        super().prepare()
        if self.subscriber.child is None or self.publisher.child is None:
            raise SettingsError(
                "--start-each-message starts subscriber and publisher itself; omit --fused, --connect, BM_SUBSCRIBER and "
                "BM_PUBLISHER"
            )

    @property
    def not_ready(self) -> list[str]:
        """The roles of peers that are not ready.

        During the run only pcie-app counts, because a new subscriber and a new publisher start for each message.
        """
        return [role for role in super().not_ready if role == self.app.role or not self.begun.is_set()]

    @property
    def _service_settings(self) -> Settings:
        # only the first of many subscribers may miss the robot, and the master has the same limit
        return super()._service_settings.model_copy(update={"first_data_timeout": LONGEST_S})

    def _dispatch(self, peer: Peer, record: AnyRecord) -> None:
        if peer in self._done:
            return
        super()._dispatch(peer, record)
        match record:
            case Reading() | Unusable() | Seen():
                self._end(peer)
            case Published():
                self._publishing = True
                # after publishing, the publisher ends only with `Seen`, when it saw the result or gave up looking
                if record.outcome is not Outcome.PUBLISHED:
                    self._end(peer)
        self._changed.set()

    def _end(self, peer: Peer) -> None:
        if peer.child is not None:
            self._done.add(peer)
            peer.ready, peer.since = False, time.monotonic()
            peer.child.terminate()

    def _awaited(self, peer: Peer) -> Awaited | None:
        if peer in self._done:
            return Awaited("end", peer.since, self._settings.stop_timeout)
        return super()._awaited(peer)

    def _ready(self, peer: Peer, record: Ready) -> None:
        begun = self.begun.is_set()
        super()._ready(peer, record)
        if self.begun.is_set() and not begun:
            self._end(self.publisher)

    def _log_ready(self, peer: Peer, record: Ready) -> None:
        if not self.begun.is_set():
            super()._log_ready(peer, record)

    async def _bring_back(self, peer: Peer) -> None:
        child, done = peer.child, peer in self._done
        if done and child is not None:
            await self._ended(child)
            self._done.remove(peer)
        if peer is self.publisher:
            self._publishing = False
        self._changed.set()
        if not done or child is None:
            await super()._bring_back(peer)
            return
        while not self._is_its_turn(peer):
            self._changed.clear()
            await self._changed.wait()
        await child.start()

    def _is_its_turn(self, peer: Peer) -> bool:
        if peer is self.publisher:
            return not self._events.is_idle and self.subscriber not in self._done
        return self._events.is_idle and not self._publishing
