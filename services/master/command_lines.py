"""Command lines of the processes that a master starts, with the settings of its run."""

from pathlib import Path

from pcie_shim.endpoint import Endpoint
from services.settings import Settings
from services.sockets.reporting import shifted
from services.supervision.child import RESTARTS, own_command

METRICS_PORTS = {"subscriber": 1, "publisher": 2, "pcie-app": 3, "board": 4}
"""Ports of the processes' metrics after that of the master; board N has the N-th after board 0."""


def _metrics(settings: Settings, role: str) -> list[str]:
    """Return the flags for the metrics of a process; the master has checked that others may read them."""
    if not settings.metrics:
        return []
    return ["--metrics", shifted(settings.metrics, METRICS_PORTS[role]), "--insecure"]


def boards_command(boards: int, directory: Path, settings: Settings, *, once: bool) -> list[str]:
    """Return the command that starts the emulated boards; with `once` it does not restart them."""
    restarts = "0" if once else str(RESTARTS)
    return [
        # one process for all of them, which loads the kernels once
        *(*own_command("board"), "--boards", str(boards)),
        *("--directory", str(directory), "--restarts", restarts),
        *_metrics(settings, "board"),
    ]


def service_command(
    role: str, endpoint: Endpoint, settings: Settings, *, compiling_time: float, reprogram: bool
) -> list[str]:
    """Return the command of a service; boards may take `compiling_time` seconds more to compile their kernels."""
    command = [*own_command(role), "--listen", str(endpoint)]
    command += ["--deployment", str(settings.deployment), "--log-level", settings.log_level]
    # settings without a value here come from the environment, which children inherit
    command += _metrics(settings, role)
    if role == "pcie-app":
        command += ["--boards", ",".join(settings.boards)] if settings.boards else []
        command += ["--stop", settings.stop] if settings.stop else []
        command += ["--peer-timeout", str(settings.peer_timeout + compiling_time)]
        command += ["--board-timeout", str(settings.board_timeout)]
        command += ["--key-file", str(settings.key_file)] if settings.key_file else []
        return [*command, "--reprogram"] if reprogram else command
    command += ["--uri", settings.uri] if settings.uri else []
    command += ["--ros-version", settings.ros_version, "--connect-timeout", str(settings.connect_timeout)]
    command += ["--ca", str(settings.ca)] if settings.ca else []
    if role == "publisher":
        return [*command, "--seen-timeout", str(settings.seen_timeout)]
    command += ["--first-data-timeout", str(settings.first_data_timeout)]
    command += ["--message-bytes", str(settings.message_bytes)]
    command += ["--topic-bytes", str(settings.topic_bytes)] if settings.topic_bytes else []
    return [*command, "--queue", settings.queue] if settings.queue else command
