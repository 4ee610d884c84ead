"""Command lines of the processes that a master starts. Their flags contain the settings of the run."""

from pathlib import Path

from pcie_shim.endpoint import Endpoint
from services.child import RESTARTS
from services.settings import Settings
from services.sockets.reporting import shifted
from terminal.processes import own_command
from toolchain.deployment import Deployment

METRICS_PORTS = {"subscriber": 1, "publisher": 2, "pcie-app": 3, "board": 4}
"""Offset of each process's metrics port from the master's metrics port. Board N adds N to the offset of `board`."""


def _metrics(settings: Settings, role: str) -> list[str]:
    """Return the flags for a process's metrics, with `--insecure`, because the master has checked the access."""
    if not settings.metrics:
        return []
    return ["--metrics", shifted(settings.metrics, METRICS_PORTS[role]), "--insecure"]


def boards_arguments(boards: int, directory: Path, settings: Settings, *, once: bool) -> list[str]:
    """Return the arguments of the `board` process that runs all emulated boards.

    With `once`, the `board` process does not restart a board.
    """
    restarts = "0" if once else str(RESTARTS)
    return [
        # one process for all of them, which loads the kernels once
        *("--boards", str(boards)),
        *("--directory", str(directory), "--restarts", restarts),
        *("--link-rate", settings.link_rate),
        *(["--read-results"] if settings.read_results else []),
        *_metrics(settings, "board"),
    ]


def dashboard_command(
    settings: Settings, deployment: Deployment, directory: Path | None, port: int
) -> list[str]:
    """Return the command of a run's dashboard. `directory` is the run directory, which contains the sockets."""
    command = [*own_command("dashboard"), "--deployment", str(deployment.directory)]
    values = {
        "uri": settings.uri,
        "ca": settings.ca,
        "ros-version": settings.ros_version,
        "run-directory": directory,
        "page-port": str(port),
    }
    for name, value in values.items():
        if value:
            command += [f"--{name}", str(value)]
    return command


_SETTINGS = {
    "subscriber": (
        *("uri", "ca", "ros_version", "connect_timeout", "first_data_timeout"),
        *("message_bytes", "topic_bytes", "queue", "use_sim_time"),
    ),
    "publisher": ("uri", "ca", "ros_version", "connect_timeout", "seen_timeout", "use_sim_time"),
    "pcie-app": ("boards", "stop", "peer_timeout", "board_timeout", "key_file"),
}
"""Settings of each service, besides the settings of all services. Settings become flags, so that `ps` shows them."""


def service_arguments(role: str, endpoint: Endpoint, settings: Settings, *, reprogram: bool) -> list[str]:
    """Return the command-line arguments with which a service listens at `endpoint`."""
    arguments = ["--listen", str(endpoint), *_metrics(settings, role)]
    for name in ("deployment", "log_level", *_SETTINGS[role]):
        value = getattr(settings, name)
        # without a value, the child takes that of the deployment as this process does
        if value is True:
            arguments.append(f"--{name.replace('_', '-')}")
        elif value not in (None, (), False):
            text = ",".join(value) if isinstance(value, tuple) else str(value)
            arguments += [f"--{name.replace('_', '-')}", text]
    return [*arguments, "--reprogram"] if reprogram else arguments
