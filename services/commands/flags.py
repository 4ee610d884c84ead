"""Flags shared by several commands."""

from pathlib import Path
from typing import Annotated, Any, Final

import typer

from services.settings import ENV_PREFIX, LONGEST_S, SHORTEST_S, Settings
from toolchain.deployment.sections import TOPIC_BYTES_MAX, TOPIC_BYTES_MIN

SERVER: Final = "rosbridge"
BOARDS: Final = "Boards"
SERVING: Final = "Under a master"
TIMEOUTS: Final = "Timeouts in seconds"
"""Groups of flags in `--help`."""


def setting(name: str, meaning: str, *names: str, otherwise: str = "", **more: Any) -> Any:
    """Return the flag of a setting, whose default is its `BM_*` variable, or else `otherwise` or that of the class."""
    default = Settings.model_fields[name].default
    otherwise = otherwise or str(default or "")
    variable = f"{ENV_PREFIX}{name.upper()}"
    return typer.Option(
        *names, help=meaning, show_default=f"{variable}, or {otherwise}" if otherwise else variable, **more
    )


def seconds(name: str, meaning: str) -> Any:
    """Return the flag of a timeout."""
    return setting(name, meaning, min=SHORTEST_S, max=LONGEST_S, rich_help_panel=TIMEOUTS)


_DEPLOYMENTS: Final = "the deployment's"

Deployment = Annotated[
    Path | None,
    setting("deployment", "Folder written by `toolchain build`.", "--deployment", "-d", metavar="DIR"),
]
Uri = Annotated[
    str | None,
    setting(
        "uri",
        "The rosbridge server.",
        otherwise=_DEPLOYMENTS,
        metavar="ws://HOST:PORT|robot:NAME",
        rich_help_panel=SERVER,
    ),
]
Ca = Annotated[
    Path | None,
    setting(
        "ca",
        "Certificates that sign that of a wss:// server.",
        otherwise="the system's",
        metavar="FILE",
        rich_help_panel=SERVER,
    ),
]
Listen = Annotated[
    str | None,
    typer.Option(
        help="Endpoint at which to wait for a master (a board: for pcie-app or a loader).",
        metavar="unix:PATH|tcp://HOST:PORT",
        rich_help_panel=SERVING,
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        help="Permit an unprotected address that other machines can reach.", rich_help_panel=SERVING
    ),
]
Run = Annotated[
    str | None, typer.Option("--run", metavar="NAME", help="One of several runs of this user, by its name.")
]
Metrics = Annotated[
    str | None,
    setting(
        "metrics",
        "Serve metrics for Prometheus, on loopback without a host; a master uses the next ports for its processes.",
        metavar="[HOST:]PORT",
    ),
]
KeyFile = Annotated[
    Path | None,
    setting(
        "key_file",
        "Key shared by boards over TCP and their hosts.",
        metavar="FILE",
        rich_help_panel=BOARDS,
    ),
]
MessageBytes = Annotated[
    int | None,
    setting(
        "message_bytes",
        "Largest message of a topic, in bytes; a larger one ends the connection, and its topic is left out of the next.",
        min=1 << 10,
        max=1 << 28,
        rich_help_panel=SERVER,
    ),
]
TopicBytes = Annotated[
    int | None,
    setting(
        "topic_bytes",
        "Largest message of each topic that is read, in bytes; larger ones are discarded and counted.",
        otherwise=_DEPLOYMENTS,
        min=TOPIC_BYTES_MIN,
        max=TOPIC_BYTES_MAX,
        rich_help_panel=SERVER,
    ),
]
RosVersion = Annotated[
    str | None,
    setting("ros_version", "Spelling of stamps and types.", metavar="auto|1|2", rich_help_panel=SERVER),
]
Queue = Annotated[
    str | None,
    setting(
        "queue",
        "Readings that wait while a frame is computed: the latest, or all (in order, at most 256).",
        otherwise=_DEPLOYMENTS,
        metavar="latest|all",
    ),
]
Stop = Annotated[
    str | None,
    setting(
        "stop",
        "When boards stop: slices (together) or own (each independently).",
        otherwise=_DEPLOYMENTS,
        metavar="slices|own",
        rich_help_panel=BOARDS,
    ),
]
Boards = Annotated[
    str | None,
    setting(
        "boards",
        "Running boards, in the order of the partitions, or the folder of `board --directory`.",
        otherwise=_DEPLOYMENTS,
        metavar="ENDPOINT,...|unix:DIR/",
        rich_help_panel=BOARDS,
    ),
]
ConnectTimeout = Annotated[float | None, seconds("connect_timeout", "To reach the rosbridge server.")]
FirstDataTimeout = Annotated[
    float | None, seconds("first_data_timeout", "Until the first reading (listen: the first result).")
]
PeerTimeout = Annotated[float | None, seconds("peer_timeout", "To reach a local process or a board.")]
BoardTimeout = Annotated[
    float | None, seconds("board_timeout", "For a board beyond its time for max_cycles.")
]
StopTimeout = Annotated[float | None, seconds("stop_timeout", "Grace period for processes to exit.")]
LogLevel = Annotated[
    str | None,
    setting("log_level", "Log level; debug logs one line per frame.", metavar="info|warning|debug"),
]
LogFormat = Annotated[
    str | None,
    setting("log_format", "Lines on standard error: text, or JSON objects.", metavar="text|json"),
]
Count = Annotated[
    int | None,
    typer.Option("--count", "-n", min=1, help="Exit after this many results (subscriber: readings)."),
]
