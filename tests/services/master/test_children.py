"""The watch over the master's children: a stopped child is noticed, one that is being restarted is not."""

import asyncio
import contextlib
from types import SimpleNamespace

from services.master import children
from services.master.children import ChildrenWatch
from services.sockets.reporting import serve_status
from services.sockets.status import ProcessStatus


async def test_a_child_that_does_not_answer_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(children, "ASK_EVERY", 0.01)
    monkeypatch.setattr(children, "STUCK_S", 1.0)
    well = [True]
    process = SimpleNamespace(is_running=True)
    peers = [SimpleNamespace(role="subscriber", child=process), SimpleNamespace(role="publisher", child=None)]
    watch = ChildrenWatch(peers, tmp_path)

    async def becomes(expected):
        async with asyncio.timeout(60):
            while watch.is_alive() != expected:
                await asyncio.sleep(0.01)

    status = ProcessStatus(ready=True, why="")
    async with serve_status(tmp_path, "subscriber", lambda: status, is_alive=lambda: well[0]):
        asking = asyncio.ensure_future(watch.run())
        await asyncio.sleep(1.5)
        assert watch.is_alive()
        well[0] = False
        await becomes(expected=False)
        process.is_running = False  # the master restarts it
        await becomes(expected=True)
        process.is_running = True
        await becomes(expected=False)
        well[0] = True
        await becomes(expected=True)
    await becomes(expected=False)  # nothing listens
    asking.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asking
