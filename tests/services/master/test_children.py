"""The watch over the master's children: a stopped child is noticed, one that is being restarted is not."""

import asyncio
import contextlib
from types import SimpleNamespace

from services.master import run
from services.master.run import ChildrenWatch
from services.sockets.reporting import STUCK_S, serve_status
from services.sockets.status import ProcessStatus
from tests.patience import PATIENCE


class Peers(list):
    """Peers that count how often they are looked through."""

    rounds = 0

    def __iter__(self):
        self.rounds += 1
        return super().__iter__()


async def test_a_child_that_does_not_answer_is_noticed(tmp_path, monkeypatch):
    now, well = [0.0], [True]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(run, "ASK_EVERY", 0.0)
    monkeypatch.setattr(run, "_ANSWER_TIME", PATIENCE)
    process = SimpleNamespace(is_running=True)
    peers = Peers(
        [SimpleNamespace(role="subscriber", child=process), SimpleNamespace(role="publisher", child=None)]
    )
    watch = ChildrenWatch(peers, tmp_path)

    async def another_round():
        begun = peers.rounds
        async with asyncio.timeout(PATIENCE):
            while peers.rounds < begun + 2:
                await asyncio.sleep(0)

    async def is_alive():
        """Return whether the child counts as alive after a long silence."""
        await another_round()  # one that has begun may still succeed
        now[0] += STUCK_S
        await another_round()
        return watch.is_alive()

    status = ProcessStatus(ready=True, why="")
    async with serve_status(tmp_path, "subscriber", lambda: status, is_alive=lambda: well[0]):
        asking = asyncio.ensure_future(watch.run())
        assert await is_alive()
        well[0] = False
        now[0] += STUCK_S - 1
        assert watch.is_alive()  # not yet
        assert not await is_alive()
        process.is_running = False  # the master restarts it
        assert await is_alive()
        process.is_running = True
        assert not await is_alive()
        well[0] = True
        assert await is_alive()
    assert not await is_alive()  # nothing listens
    asking.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asking
