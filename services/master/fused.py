"""The three services inside the process of the master (`master --fused`).

    Peers ◀──── FusedLink.send ──── Subscriber, Publisher, PcieApp
          ───── FusedEnd.send ────▶

Records are passed in function calls, without encoding and without local sockets. Boards remain separate processes
or devices.
"""

from collections.abc import Callable, Coroutine
from typing import Any, cast

from services.boards.deployed import DeployedBoards
from services.master.command_lines import METRICS_PORTS
from services.pipeline.pcie_app import PcieApp
from services.pipeline.publisher import Publisher
from services.pipeline.subscriber import Subscriber
from services.settings import Settings
from services.sockets.records import AnyRecord, Record
from services.sockets.reporting import shifted
from services.sockets.serving import Link, MakeLink, RunService, board_endpoints
from toolchain.deployment import Deployment

TakeRecord = Callable[[AnyRecord], None]


class FusedLink(Link):
    """Link of a service to the master in the same process."""

    def __init__(self, to_master: TakeRecord) -> None:
        # None after the end of the service
        self._to_master: TakeRecord | None = to_master

    async def __aexit__(self, *_: object) -> None:
        """Stop passing on records."""
        self._to_master = None

    @property
    def has_master(self) -> bool:
        """True while the link is open."""
        return self._to_master is not None

    def send(self, record: Record) -> bool:
        """Pass a record to the master and return True, or return False if the link is closed."""
        if self._to_master is None:
            return False
        self._to_master(cast("AnyRecord", record))
        return True


class FusedEnd:
    """The master's end of a link inside one process. It replaces a socket connection."""

    def __init__(self, role: str, to_service: TakeRecord) -> None:
        self.where = f"{role} in this process"
        self._to_service = to_service

    def send(self, record: Record) -> bool:
        """Pass a record to the service."""
        self._to_service(cast("AnyRecord", record))
        return True

    def close(self) -> None:
        """Do nothing, because the service ends when its task is cancelled."""


def fused_services(
    settings: Settings, deployment: Deployment, to_master: Callable[[str], TakeRecord]
) -> dict[str, tuple[FusedEnd, Coroutine[Any, Any, int]]]:
    """Return, for each of the three roles, the master's end of the link and the coroutine that runs the service.

    `to_master` returns the function that receives the records of a role. Raises a SettingsError for a wrong endpoint.
    """
    # filled by the constructors of the services, which make their links
    ends: dict[str, FusedEnd] = {}

    def link_of(role: str) -> MakeLink:
        def make(to_service: TakeRecord) -> Link:
            ends[role] = FusedEnd(role, to_service)
            return FusedLink(to_master(role))

        return make

    # as if each were a process of its own
    def settings_of(role: str) -> Settings:
        return settings.model_copy(update={"metrics": shifted(settings.metrics, METRICS_PORTS[role])})

    boards = DeployedBoards(settings, deployment, board_endpoints(settings, deployment))
    services: list[RunService] = [
        Subscriber(settings_of(Subscriber.role), deployment, link_of(Subscriber.role)),
        Publisher(settings_of(Publisher.role), deployment, link_of(Publisher.role)),
        PcieApp(settings_of(PcieApp.role), boards, link_of(PcieApp.role)),
    ]
    return {service.role: (ends[service.role], service.run()) for service in services}
