"""Command lines of the processes that a master starts, with the settings of its run."""

from pathlib import Path

from pcie_shim.endpoint import Endpoint
from services.settings import Settings
from services.supervision.child import RESTARTS, own_command


def boards_command(boards: int, directory: Path, *, once: bool) -> list[str]:
    """Return the command that starts the emulated boards; with `once` it does not restart them."""
    restarts = "0" if once else str(RESTARTS)
    return [
        *(*own_command("board"), "--boards", str(boards)),
        *("--directory", str(directory), "--restarts", restarts),
    ]


def service_command(
    role: str, endpoint: Endpoint, settings: Settings, *, compiling_time: float, reprogram: bool
) -> list[str]:
    """Return the command of a service; boards may take `compiling_time` seconds more to compile their kernels."""
    command = [*own_command(role), "--listen", str(endpoint)]
    command += ["--deployment", str(settings.deployment), "--log-level", settings.log_level]
    if role == "pcie-app":
        command += ["--boards", ",".join(settings.boards)] if settings.boards else []
        command += ["--stop", settings.stop] if settings.stop else []
        command += ["--peer-timeout", str(settings.peer_timeout + compiling_time)]
        command += ["--board-timeout", str(settings.board_timeout)]
        command += ["--key-file", str(settings.key_file)] if settings.key_file else []
        command += ["--board-ca", str(settings.board_ca)] if settings.board_ca else []
        return [*command, "--reprogram"] if reprogram else command
    command += ["--uri", settings.uri] if settings.uri else []
    command += ["--ros-version", settings.ros_version, "--connect-timeout", str(settings.connect_timeout)]
    command += ["--ca", str(settings.ca)] if settings.ca else []
    if role == "publisher":
        return [*command, "--seen-timeout", str(settings.seen_timeout)]
    command += ["--first-data-timeout", str(settings.first_data_timeout)]
    command += ["--message-bytes", str(settings.message_bytes)]
    return [*command, "--queue", settings.queue] if settings.queue else command
