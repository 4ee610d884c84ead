"""Reloads of the deployment of a run, in which every frame is computed entirely by one deployment.

readings of the old one ──▶ finished ──┐
readings of the new one ──▶ wait ······┴─ boards get the new tables ──▶ computed
"""

import asyncio
import time
from pathlib import Path
from typing import Any

from structlog.typing import FilteringBoundLogger

from services.errors import NotReloadedError, ReportedError, SettingsError, StackError
from services.master.flow import FrameFlow
from services.master.new_deployment import forget, keep, read_new
from services.master.peers import ANSWER_TIME, Peer, Peers
from services.pipeline.generations import InForce
from services.settings import Settings
from services.sockets.control_socket import ReloadOrder
from services.sockets.records import LossReason, NotReloaded, Prepare, Switch, Switched
from toolchain.deployment import Deployment

_DRAIN_TIME = 30.0
"""Seconds that a reload waits for the frames in flight."""

_DRAIN_EVERY = 0.01
_PROGRAM_TIME = 30.0
"""Maximum time in seconds to program one board in a reload."""


class Reloads:
    """Reloads of a run, one at a time."""

    def __init__(
        self, settings: Settings, in_force: InForce, peers: Peers, flow: FrameFlow, log: FilteringBoundLogger
    ) -> None:
        self._settings = settings
        self._in_force = in_force
        self._peers = peers
        self._flow = flow
        self._log = log
        self._one_at_a_time = asyncio.Lock()

    async def order(self, order: ReloadOrder) -> str:
        """Reload; return a sentence about it.

        Raises:
            StackError, ToolchainError: The reason why the run keeps its deployment.
        """
        if self._one_at_a_time.locked():
            raise NotReloadedError("another reload is in progress; try again when it has finished")
        folder = Path(order.folder or self._in_force.folder)
        async with self._one_at_a_time:
            try:
                sentence = await self._reload(folder)
            except Exception as error:
                hash_ = self._in_force.deployment.hash[:12]
                self._log.warning(f"not reloaded: {error}; deployment {hash_} stays in force")
                raise
            self._log.info(sentence)
            return sentence

    async def _reload(self, folder: Path) -> str:
        """Let all services read the new deployment, drain the frames of the old one, and switch.

        The subscriber switches first; from then on its readings wait in the flow. The boards follow when no
        frame is in flight. After that the reload cannot be undone, and the publisher follows.
        """
        waiting = self._peers.not_ready
        if waiting or not self._peers.begun.is_set():
            raise NotReloadedError(
                f"the run is not ready: it waits for {' and '.join(waiting) or 'its processes'}; try again when it has started"
            )
        if not folder.is_absolute():
            raise SettingsError(
                f"the folder {folder} is not absolute, and the master may run in another folder; give an absolute path"
            )
        started = time.monotonic()
        lost_before = self._lost
        number = self._in_force.generation + 1
        new = await asyncio.to_thread(read_new, folder, self._in_force.deployment, self._without_overridden)
        kept = await self._keep_copy(new, number)
        subscriber, publisher, app = self._peers.subscriber, self._peers.publisher, self._peers.app
        limit = self._settings.peer_timeout + ANSWER_TIME
        for peer in (subscriber, publisher, app):
            where = kept if peer.child is not None else folder
            await self._ask(peer, Prepare(number, str(where), new.hash), limit, kept, folder)
        in_flight = 0
        try:
            self._flow.expect_next_generation()
            await self._ask(subscriber, Switch(number), limit)
            in_flight = self._flow.in_flight
            await self._drain()
            self._flow.hold()
            if app.child is not None:
                app.child.set_flag("--reprogram")  # if it is restarted meanwhile, boards hold either image
            boards = len(new.boards) * max(_PROGRAM_TIME, self._settings.peer_timeout)
            await self._ask(app, Switch(number), limit + boards)
        except asyncio.CancelledError:  # the run ends, so services need not switch back
            self._flow.drop_next_generation()
            raise
        except Exception:
            await self._go_back()
            raise
        lost = self._flow.waiting
        self._adopt(new, folder, kept)
        for peer in (publisher, subscriber):
            await self._switch_or_renew(peer, limit)
        lost_meanwhile = self._lost - lost_before - lost
        milliseconds = (time.monotonic() - started) * 1000
        return (
            f"generation {number} is in force, deployment {new.hash[:12]} of {folder}; "
            f"{describe_frames(in_flight, lost, lost_meanwhile)}, {milliseconds:.0f} ms"
        )

    @property
    def _lost(self) -> int:
        return self._flow.losses[LossReason.IN_RELOAD]

    async def _ask(
        self,
        peer: Peer,
        record: Prepare | Switch,
        limit: float,
        kept: Path | None = None,
        folder: Path | None = None,
    ) -> None:
        """Let a service prepare or switch.

        Raises:
            NotReloadedError: It is not connected, exited, or did not answer in time (then it is killed).
            ReportedError: It failed, with its own sentence.
        """
        if peer.protocol is None or not peer.ready:
            raise NotReloadedError(f"{peer.role} is not available now; try again when it is back")
        peer.answer = asyncio.get_running_loop().create_future()
        try:
            if not peer.protocol.send(record):
                raise NotReloadedError(f"{peer.role} ended meanwhile")
            answer = await asyncio.wait_for(peer.answer, limit)
        except TimeoutError as error:
            what = "read the new deployment" if isinstance(record, Prepare) else "switch to it"
            sentence = f"{peer.role} at {peer.where} did not {what} within {limit:g} s"
            self._peers.renew(peer, f"{sentence}; ending it")
            raise NotReloadedError(sentence) from error
        finally:
            peer.answer = None
        if isinstance(answer, NotReloaded):
            # the user knows the original folder, not the path of its copy
            sentence = answer.sentence.replace(str(kept), str(folder)) if kept else answer.sentence
            raise ReportedError(answer.exit_code, f"{peer.role}: {sentence}")
        if isinstance(answer, Switched):
            peer.generation = answer.generation

    async def _drain(self) -> None:
        """Wait for the frames of the deployment in force, and drop those that still wait for the boards then.

        Raises:
            NotReloadedError: A frame or a result takes too long.
        """
        deadline = time.monotonic() + _DRAIN_TIME
        while self._flow.in_flight:
            if time.monotonic() > deadline:
                if busy_with := self._flow.busy_with:
                    raise NotReloadedError(f"{busy_with} took longer than {_DRAIN_TIME:g} s; try again")
                return
            await asyncio.sleep(_DRAIN_EVERY)

    async def _go_back(self) -> None:
        """Switch services back to the deployment in force."""
        self._flow.drop_next_generation()
        limit = ANSWER_TIME + len(self._in_force.deployment.boards) * _PROGRAM_TIME
        for peer in self._peers:
            if peer.ready:
                await self._switch_or_renew(peer, limit)
        self._flow.resume()

    async def _switch_or_renew(self, peer: Peer, limit: float) -> None:
        """Let a service use the deployment in force, and restart it if it does not switch."""
        generation = self._in_force.generation
        if peer.generation != generation and peer.protocol is not None:
            try:
                await self._ask(peer, Switch(generation), limit)
            except StackError as error:
                self._peers.renew(peer, f"{error}; ending it")

    def _adopt(self, new: Deployment, folder: Path, kept: Path) -> None:
        """Put the deployment into force whose tables the boards have."""
        self._in_force.replace(new, folder)
        self._peers.set_flag("--deployment", str(kept))
        self._peers.app.generation = self._in_force.generation
        if self._peers.directory is not None:
            # a child may still be reading the previous copy
            forget(self._peers.directory, self._in_force.generation - 2)
        self._flow.adopt_next_generation()
        self._flow.resume()

    def _without_overridden(self, deployment: Deployment) -> Deployment:
        """Return a deployment without the fields that flags of this run override, so that these may differ."""
        update: dict[str, Any] = {}
        if self._settings.uri:
            uri = self._settings.uri
            update["sources"] = tuple(each.model_copy(update={"uri": uri}) for each in deployment.sources)
            update["outputs"] = tuple(each.model_copy(update={"uri": uri}) for each in deployment.outputs)
        if self._settings.queue:
            update["queue"] = self._settings.queue
        if self._peers.board_endpoints:
            update["boards"] = tuple(each.model_copy(update={"endpoint": ""}) for each in deployment.boards)
        return deployment.model_copy(update=update)

    async def _keep_copy(self, deployment: Deployment, number: int) -> Path:
        """Copy a deployment for children; return the folder for them to read."""
        if self._peers.directory is None or not any(peer.child for peer in self._peers):
            return deployment.directory
        return await asyncio.to_thread(keep, deployment, self._peers.directory, number)

    async def keep_first(self) -> None:
        """Copy the first deployment after the start, so that restarted children read it unchanged."""
        await self._peers.begun.wait()
        try:
            kept = await self._keep_copy(self._in_force.deployment, 0)
        except Exception as error:  # without a copy, they read the original folder
            self._log.warning(
                f"restarted services will read the then current {self._in_force.folder}: {error}"
            )
            return
        if self._in_force.generation == 0:
            self._peers.set_flag("--deployment", str(kept))


def describe_frames(in_flight: int, lost: int, lost_meanwhile: int = 0) -> str:
    """Return a text about the frames in flight at the start of a reload and the readings lost during it.

    `lost` frames were still waiting for the boards after the drain; `lost_meanwhile` readings did not fit
    into the queue.
    """
    frames = "1 frame was" if in_flight == 1 else f"{in_flight} frames were"
    text = f"{frames} in flight and finished before"
    if lost:
        text = f"{frames} in flight: {in_flight - lost} finished before, {lost} lost after {_DRAIN_TIME:g} s"
    if lost_meanwhile:
        readings = "1 reading" if lost_meanwhile == 1 else f"{lost_meanwhile} readings"
        text += f"; {readings} that came meanwhile found no place to wait and {'was' if lost_meanwhile == 1 else 'were'} lost"
    return text
