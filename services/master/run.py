"""A run of the master: the start of its peers, the flow of frames between the peers, and the end."""

import asyncio
import contextlib
import sys
import time
from collections import Counter
from collections.abc import Coroutine, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.child import Child, end_all
from services.errors import NoDataError, StackError
from services.master.command_lines import dashboard_command
from services.master.each_message import EachMessagePeers
from services.master.flow import FrameFlow
from services.master.peers import ROLE, Peer, Peers
from services.settings import Settings
from services.sockets.records import LossReason, Publish, Published
from services.sockets.reporting import STUCK_S, serve_status
from services.sockets.status import ProcessStatus, read_process_status
from terminal.errors import ExitCode
from terminal.health import NoHealthError, status_socket
from terminal.logs import get_logger
from terminal.output import say, show_progress
from terminal.run_directory import OccupiedError
from toolchain.deployment import Deployment

if TYPE_CHECKING:
    from services.output.posterior_output import Show

ASK_EVERY = 5.0
"""Seconds between two checks of whether all children make progress."""
_ANSWER_TIME = 2.0
_LOCK_EVERY = 0.05
_PROGRESS_EVERY = 1.0
_DRAWN_EVERY = 0.2
"""Minimum number of seconds between two pictures, so that drawing takes little time from the frames."""
_REASON_TIME = 5.0
"""Seconds beyond `seen_timeout` for the publisher to ask the server why no result was seen."""
_GRACE_PERIOD = 2.0
"""Delay in seconds of the master's report that no reading came, because the subscriber's own report says more."""


class Master:
    """A run of the master with one deployment. Create it inside the event loop that executes `run`."""

    def __init__(
        self,
        settings: Settings,
        deployment: Deployment,
        *,
        once: bool,
        count: int | None,
        json: bool,
        plot: bool = False,
        page_port: int | None = None,
        start_each_message: bool = False,
    ) -> None:
        self._settings = settings
        self._once = once
        self._count = 1 if once else count
        self._json = json
        self._plot = plot
        # Not together with results: they would overwrite each other on a terminal, even if results go through a pipe.
        self._shows_progress = not (once or json or plot)
        # The last published result, for the progress; and the last drawn one, which is drawn only once.
        self._newest: Published | None = None
        self._drawn: Publish | None = None
        self._log = get_logger(ROLE, settings.log_level)
        self._deployment = deployment
        kind = EachMessagePeers if start_each_message else Peers
        self._peers = kind(settings, deployment, self._log, once=once)
        self._flow = FrameFlow(
            settings, deployment, self._peers, self._log, once=once, count=self._count, show=self._show
        )
        # The page in the browser, which only reads: its failure never ends the run. Made in `run`, if it has a port.
        self._page_port = page_port
        self._page: Child | None = None
        # Tasks that run beside the frames until the end of the run.
        self._tasks: list[asyncio.Task[None]] = []

    async def run(self) -> int:
        """Start missing peers, pass frames between them, and stop the started peers, or raise a StackError."""
        settings, peers = self._settings, self._peers
        sockets = contextlib.AsyncExitStack()
        try:
            await self._prepare_peers()
            run_directory = peers.directory or settings.run_directory
            more: dict[str, Any] = {}
            # with --connect alone, the run has no folder, and its services are watched by whoever started them
            if run_directory is not None:
                watch = ChildrenWatch(peers, run_directory)
                self._begin_task(watch.run())
                more["is_alive"] = watch.is_alive
            report = serve_status(
                run_directory,
                ROLE,
                self.status,
                metrics=settings.metrics,
                stages=self._flow.latencies.summary,
                **more,
            )
            await sockets.enter_async_context(report)
            if self._shows_progress and sys.stderr.isatty():
                self._begin_task(self._show_progress())
            self._begin_task(self._expect_data())
            if self._page_port is not None:
                command = dashboard_command(settings, self._deployment, run_directory, self._page_port)
                self._page = Child("dashboard", command)
                self._begin_task(self._keep_page(self._page))
            with self._drawing() as show:
                if show is not None:
                    self._begin_task(self._keep_drawing(show))
                await peers.start(self._flow)
                # only now, because it takes long, and the processes are starting meanwhile
                import_module("services.output.master_output")
                await self._flow.end
                # a run of few frames may be over before it is known whether anybody can receive them
                if self._flow.published and not self._once:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(self._flow.looked.wait(), settings.seen_timeout + _REASON_TIME)
                # the last result, which may be newer than the last picture
                if show is not None:
                    self._draw(show)
        finally:
            for task in self._tasks:
                task.cancel()
            await peers.leave()
            # before the children end, because the private folder that contains the socket goes with them
            await sockets.aclose()
            if self._page is not None:
                await end_all([self._page], settings.stop_timeout)
            await peers.end()
            # a run that ended before a reading could arrive needs no summary
            if not self._once and self._peers.begun.is_set():
                say(self.summary())
        return ExitCode.DONE

    async def _prepare_peers(self) -> None:
        """Prepare the peers; wait a moment for processes of a killed run that still hold the run directory."""
        deadline = time.monotonic() + self._settings.stop_timeout
        while True:
            try:
                return self._peers.prepare()
            except OccupiedError:
                if time.monotonic() >= deadline:
                    raise
            await asyncio.sleep(_LOCK_EVERY)

    async def _keep_page(self, page: Child) -> None:
        try:
            await page.start()
            await page.wait()
            failure = page.failure()
        except StackError as error:
            failure = error
        self._log.warning(f"{failure}; the run goes on without the page")

    def _begin_task(self, work: Coroutine[Any, Any, None]) -> None:
        self._tasks.append(asyncio.ensure_future(work))

    def status(self) -> ProcessStatus:
        """Return the status of the run as a whole."""
        frames = self._flow.counts()
        age, waiting = frames.last_age_s, self._peers.not_ready
        if waiting:
            why = f"waiting for {' and '.join(waiting)}"
        elif age is None:
            why = "no result yet: waiting for a complete reading"
        # in a simulation, which may be paused, the subscriber knows whether readings are due
        elif age > self._settings.ready_timeout and not self._settings.use_sim_time:
            why = f"no result for {age:.0f} s"
        else:
            why = ""
        return ProcessStatus(
            ready=not why,
            why=why or "results flow",
            deployment=self._deployment.hash,
            folder=str((self._settings.deployment or self._deployment.directory).absolute()),
            peers=self._peers.status(),
            frames=frames,
        )

    def summary(self) -> str:
        """Return a sentence about the results and losses of the run."""
        losses = Counter(self._flow.losses)
        # waiting for the robot does not count
        began = self._flow.first_reading_at
        elapsed = 0.0 if began is None else time.monotonic() - began
        published = self._flow.published
        text = f"{published} result{'s' if published != 1 else ''} published in {elapsed:.1f} s"
        # results that were published, but not on all of their topics
        if missed := losses.pop(LossReason.SOME_TOPICS, 0):
            text += f", {missed} of them {LossReason.SOME_TOPICS}"
        if self._flow.seen is False:
            text += ", but none was seen on the wire"
        lost = ", ".join(f"{count} {reason}" for reason, count in losses.items() if count)
        return f"{text}; not published: {lost}" if lost else text

    def _show(self, record: Published) -> None:
        """Print a published result if requested."""
        from services.output.master_output import print_json, sentence

        self._newest = record
        if self._json:
            print_json(record, self._deployment)
        elif self._once and not self._plot:
            print(sentence(record, self._deployment), flush=True)
        if record.seen is False:
            say(
                f"the result was published, but not seen on the wire within {self._settings.seen_timeout:g} s"
            )

    async def _expect_data(self) -> None:
        """End the run with a NoDataError if no reading arrives in time after its start."""
        # not earlier, because nobody listens until then, and each phase of the start has its own limit
        await self._peers.begun.wait()
        limit = self._settings.first_data_timeout
        await asyncio.sleep(limit + _GRACE_PERIOD)
        if not self._flow.has_data:
            topics = ", ".join(source.topic for source in self._deployment.sources)
            clock = "; with --use-sim-time, /clock is needed too" if self._settings.use_sim_time else ""
            self._flow.fail(NoDataError(f"no reading came from {topics} within {limit:g} s{clock}"))

    async def _show_progress(self) -> None:
        from services.output.master_output import sentence

        # of the last line of progress: its time, and the number of results published until then
        before, count = time.monotonic(), 0
        while True:
            await asyncio.sleep(_PROGRESS_EVERY)
            now, published = time.monotonic(), self._flow.published
            if published != count:
                began = max(before, self._flow.first_reading_at or before)
                rate = (published - count) / (now - began) if now > began else 0.0
                of = f" of {self._count}" if self._count else ""
                newest = "" if self._newest is None else f"; {sentence(self._newest, self._deployment)}"
                show_progress(f"{ROLE}: {published}{of} results, {rate:.0f} a second{newest}")
            before, count = now, published

    def _drawing(self) -> contextlib.AbstractContextManager["Show | None"]:
        if not self._plot:
            return contextlib.nullcontext()
        from services.output.posterior_output import drawing

        return drawing()

    async def _keep_drawing(self, show: "Show") -> None:
        while True:
            await asyncio.sleep(_DRAWN_EVERY)
            self._draw(show)

    def _draw(self, show: "Show") -> None:
        """Draw the newest posterior, unless it is drawn already."""
        from posteriors.axes import deployment_axes
        from services.output.master_output import posterior_of

        newest = self._flow.newest
        if newest is None or newest is self._drawn:
            return
        self._drawn = newest
        posterior = posterior_of(newest, self._deployment)
        if posterior is not None:
            show(posterior, deployment_axes(self._deployment))


class ChildrenWatch:
    """Regular queries of the status sockets of the processes that a master started.

    Without the queries, the master would not notice that a child without work is stopped or stuck. Children that are
    being restarted are not queried.
    """

    def __init__(self, peers: Iterable[Peer], directory: Path) -> None:
        """Store the peers of the master, and the directory of the peers' status sockets."""
        self._peers = peers
        self._directory = directory
        # When all of them last answered (monotonic, s). At first they have as long to start.
        self._answered = time.monotonic()

    def is_alive(self) -> bool:
        """Return whether all running children have answered recently."""
        return time.monotonic() - self._answered < STUCK_S

    async def run(self) -> None:
        """Query the status sockets regularly until cancelled."""
        while True:
            # one that is not ready has a time limit of its own
            running = [
                peer.role for peer in self._peers if peer.ready and peer.child and peer.child.is_running
            ]
            if all(await asyncio.gather(*map(self._is_well, running))):
                self._answered = time.monotonic()
            await asyncio.sleep(ASK_EVERY)

    async def _is_well(self, role: str) -> bool:
        try:
            return (await read_process_status(status_socket(self._directory, role), _ANSWER_TIME)).alive
        except NoHealthError:
            return False
