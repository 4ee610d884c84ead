"""Reloading: a run takes another deployment, so that every frame is computed by one of them, whole.

readings of the old one ──▶ finished ──┐
readings of the new one ──▶ wait ······┴─ boards get the new tables ──▶ computed
"""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any, Protocol

from structlog.typing import FilteringBoundLogger

from services.errors import NotReloadedError, ReportedError, SettingsError, StackError
from services.master.new_deployment import forget, keep, read_new
from services.master.peers import ANSWER_TIME, Peer, Peers
from services.pipeline.frames import WaitingFrames
from services.pipeline.generations import InForce
from services.settings import Settings
from services.sockets.control_socket import ReloadOrder
from services.sockets.records import NotReloaded, Prepare, Reading, Switch, Switched
from toolchain.deployment import Deployment

LOST_IN_RELOAD = "lost in a reload"

Waits = tuple[Reading, int]
"""A reading that waits for the boards, and when it came to the master (monotonic, ns)."""

_DRAIN_TIME = 30.0
"""Seconds that the frames under way may take, once a reload waits for them."""

_DRAIN_EVERY = 0.01
_PROGRAM_TIME = 30.0
"""Seconds that programming one board may take in a reload, at most."""


class Moving(Protocol):
    """What moves, as a reload sees it: the run."""

    @property
    def has_begun(self) -> bool:
        """Whether all peers were ready once."""

    @property
    def waiting(self) -> int:
        """How many readings wait for the boards."""

    @property
    def under_way(self) -> str:
        """Where frames are: on the boards, at the publisher; nothing if there are none."""

    @property
    def in_flight(self) -> int:
        """How many frames wait, are computed, or are being published."""

    def hold(self) -> None:
        """Hand no frame to pcie-app."""

    def go_on(self, readings: WaitingFrames[Waits] | None = None) -> None:
        """Hand frames on again: these readings, where there are any, in place of those that wait."""

    def lose(self, reason: str, count: int) -> None:
        """Count what was lost."""

    def lost_for(self, reason: str) -> int:
        """How many were lost for a reason so far."""


class Reloads:
    """Another deployment for a run, one at a time."""

    def __init__(
        self, settings: Settings, in_force: InForce, peers: Peers, moving: Moving, log: FilteringBoundLogger
    ) -> None:
        self._settings = settings
        self._in_force = in_force
        self._peers = peers
        self._moving = moving
        self._log = log
        self._one_at_a_time = asyncio.Lock()
        self._coming: WaitingFrames[Waits] | None = None

    def wait(self, waits: Waits) -> None:
        """A reading of the deployment that comes next waits until the boards have its tables."""
        if self._coming is None or waits[0].generation != self._in_force.generation + 1:
            self._moving.lose(LOST_IN_RELOAD, 1)
            return
        try:
            self._coming.put(waits)
        except StackError:  # the boards are no slow part while they are programmed
            self._moving.lose(LOST_IN_RELOAD, 1)

    async def order(self, order: ReloadOrder) -> str:
        """Reload; gives a sentence about it.

        Raises:
            StackError, ToolchainError: why the run goes on with the deployment that it had.
        """
        if self._one_at_a_time.locked():
            msg = "another reload is under way; try again when it is done"
            raise NotReloadedError(msg)
        folder = Path(order.folder or self._in_force.folder)
        async with self._one_at_a_time:
            try:
                sentence = await self._reload(folder)
            except Exception as error:
                hash_ = self._in_force.deployment.hash[:12]
                self._log.warning(f"not reloaded: {error}; deployment {hash_} goes on")
                raise
            self._log.info(sentence)
            return sentence

    async def _reload(self, folder: Path) -> str:
        """Have everybody read the new deployment, wait for the frames of the old one, and switch.

        The subscriber switches first: what it sends from then on waits here. Then the boards, when no frame is under
        way; from there on there is no way back, and the publisher follows.
        """
        waiting = self._peers.not_ready
        if waiting or not self._moving.has_begun:
            msg = f"the run is not ready: it waits for {' and '.join(waiting) or 'its processes'}; try again when it has begun"
            raise NotReloadedError(msg)
        if not folder.is_absolute():
            msg = f"the folder {folder} is not absolute, and the master may stand somewhere else; give the whole path"
            raise SettingsError(msg)
        started = time.monotonic()
        lost_before = self._moving.lost_for(LOST_IN_RELOAD)
        number = self._in_force.generation + 1
        new = await asyncio.to_thread(read_new, folder, self._in_force.deployment, self._as_used)
        kept = await self._keep_copy(new, number)
        subscriber, publisher, app = self._peers.subscriber, self._peers.publisher, self._peers.app
        limit = self._settings.peer_timeout + ANSWER_TIME
        for peer in (subscriber, publisher, app):
            where = kept if peer.child is not None else folder
            await self._ask(peer, Prepare(number, str(where), new.hash), limit, kept, folder)
        in_flight = 0
        try:
            self._coming = WaitingFrames(self._settings.queue or self._in_force.deployment.queue)
            await self._ask(subscriber, Switch(number), limit)
            in_flight = self._moving.in_flight
            await self._drain()
            self._moving.hold()
            if app.child is not None:
                app.child.give("--reprogram")  # if it is restarted in between, boards hold either image
            boards = len(new.boards) * max(_PROGRAM_TIME, self._settings.peer_timeout)
            await self._ask(app, Switch(number), limit + boards)
        except asyncio.CancelledError:  # the run ends: nobody is left who could go back
            self._lose_coming()
            raise
        except Exception:
            await self._go_back()
            raise
        lost = self._moving.waiting
        self._adopt(new, folder, kept)
        for peer in (publisher, subscriber):
            if peer.generation != number and peer.protocol is not None:
                try:
                    await self._ask(peer, Switch(number), limit)
                except StackError as error:
                    self._peers.renew(peer, f"{error}; ending it")
        lost_meanwhile = self._moving.lost_for(LOST_IN_RELOAD) - lost_before - lost
        milliseconds = (time.monotonic() - started) * 1000
        return (
            f"generation {number} is in force, deployment {new.hash[:12]} of {folder}; "
            f"{what_became_of(in_flight, lost, lost_meanwhile)}, {milliseconds:.0f} ms"
        )

    async def _ask(
        self,
        peer: Peer,
        record: Prepare | Switch,
        limit: float,
        kept: Path | None = None,
        folder: Path | None = None,
    ) -> None:
        """Have a service prepare or switch.

        Raises:
            NotReloadedError: It is not there, ended, or did not answer in time (then it is ended).
            ReportedError: It could not, in its own words.
        """
        if peer.protocol is None or not peer.ready:
            msg = f"{peer.role} is not there now; try again when it is back"
            raise NotReloadedError(msg)
        what = "read the new deployment" if isinstance(record, Prepare) else "switch to it"
        peer.answer = asyncio.get_running_loop().create_future()
        try:
            if not peer.protocol.send(record):
                msg = f"{peer.role} ended meanwhile"
                raise NotReloadedError(msg)
            answer = await asyncio.wait_for(peer.answer, limit)
        except TimeoutError as error:
            msg = f"{peer.role} at {peer.where} did not {what} within {limit:g} s"
            self._peers.renew(peer, f"{msg}; ending it")
            raise NotReloadedError(msg) from error
        finally:
            peer.answer = None
        if isinstance(answer, NotReloaded):
            # a copy's path says nothing to who made the folder
            said = answer.sentence.replace(str(kept), str(folder)) if kept else answer.sentence
            raise ReportedError(answer.exit_code, f"{peer.role}: {said}")
        if isinstance(answer, Switched):
            peer.generation = answer.generation

    async def _drain(self) -> None:
        """Wait for the frames of the deployment that is in force; those that still wait after that are lost.

        Raises:
            NotReloadedError: A frame or a result is under way for too long.
        """
        deadline = time.monotonic() + _DRAIN_TIME
        while self._moving.in_flight:
            if time.monotonic() > deadline:
                if under_way := self._moving.under_way:
                    msg = f"{under_way} took longer than {_DRAIN_TIME:g} s; try again"
                    raise NotReloadedError(msg)
                return
            await asyncio.sleep(_DRAIN_EVERY)

    async def _go_back(self) -> None:
        """Have whoever switched already work by the deployment in force again."""
        self._lose_coming()
        in_force = self._in_force
        for peer in self._peers:
            if peer.generation != in_force.generation and peer.protocol is not None and peer.ready:
                try:
                    limit = ANSWER_TIME + len(in_force.deployment.boards) * _PROGRAM_TIME
                    await self._ask(peer, Switch(in_force.generation), limit)
                except StackError as error:
                    self._peers.renew(peer, f"{error}; ending it")
        self._moving.go_on()

    def _lose_coming(self) -> None:
        """Count the readings that waited for tables which do not come."""
        coming, self._coming = self._coming, None
        if coming is not None:
            self._moving.lose(LOST_IN_RELOAD, len(coming))
            self._moving.lose("passed over", coming.passed_over)

    def _adopt(self, new: Deployment, folder: Path, kept: Path) -> None:
        """The boards have the new tables: hand on the readings that were made for them."""
        self._in_force.replace(new, folder)
        self._peers.give("--deployment", str(kept))
        self._peers.app.generation = self._in_force.generation
        if self._peers.directory is not None:
            # a child may be reading the last one's just now
            forget(self._peers.directory, self._in_force.generation - 2)
        coming, self._coming = self._coming, None
        self._moving.go_on(coming)

    def _as_used(self, deployment: Deployment) -> Deployment:
        """A deployment without what this run's flags override: it need not be the same in the next one."""
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
        """Copy a deployment for children; gives the folder that they are to read."""
        if self._peers.directory is None or not any(peer.child for peer in self._peers):
            return deployment.directory
        return await asyncio.to_thread(keep, deployment, self._peers.directory, number)

    async def keep_first(self) -> None:
        """Children that are restarted find the deployment of the run's beginning, whatever is built into its folder since."""
        try:
            kept = await self._keep_copy(self._in_force.deployment, 0)
        except Exception as error:  # without a copy, they read the folder itself
            self._log.warning(f"restarted services will read {self._in_force.folder} as it is then: {error}")
            return
        if self._in_force.generation == 0:
            self._peers.give("--deployment", str(kept))


def what_became_of(in_flight: int, lost: int, lost_meanwhile: int = 0) -> str:
    """Of the frames that were under way when a reload began, and of the readings that came during it, in words.

    Args:
        in_flight: how many frames there were.
        lost: how many of them still waited after all the time that they could have.
        lost_meanwhile: how many readings came while boards were programmed and found no place to wait.
    """
    frames = "1 frame was" if in_flight == 1 else f"{in_flight} frames were"
    said = f"{frames} in flight and finished before"
    if lost:
        said = f"{frames} in flight: {in_flight - lost} finished before, {lost} lost after {_DRAIN_TIME:g} s"
    if lost_meanwhile:
        readings = "1 reading" if lost_meanwhile == 1 else f"{lost_meanwhile} readings"
        said += f"; {readings} that came meanwhile found no place to wait and {'was' if lost_meanwhile == 1 else 'were'} lost"
    return said
