"""Flags shared by several commands."""

from pathlib import Path
from typing import Annotated, Any

import typer

from services.settings import LONGEST_S, SHORTEST_S


def _seconds(meaning: str) -> Any:
    return typer.Option(min=SHORTEST_S, max=LONGEST_S, help=meaning)


Deployment = Annotated[
    Path | None,
    typer.Option("--deployment", "-d", help="Folder written by `toolchain build`.", metavar="DIR"),
]
Uri = Annotated[
    str | None,
    typer.Option(help="rosbridge server, instead of the deployment's.", metavar="ws://HOST:PORT|robot:NAME"),
]
Listen = Annotated[
    str | None,
    typer.Option(
        help="Serve at this endpoint (a master; a board: its host) instead of standard input and output.",
        metavar="unix:PATH|tcp://HOST:PORT",
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(help="Permit an unprotected address that other machines can reach."),
]
KeyFile = Annotated[
    Path | None,
    typer.Option(help="Key shared by boards over TCP and their hosts.", metavar="FILE"),
]
BoardCa = Annotated[
    Path | None,
    typer.Option(help="Certificates that sign those of boards over TLS (the system's).", metavar="FILE"),
]
RosVersion = Annotated[str | None, typer.Option(help="Spelling of stamps and types.", metavar="auto|1|2")]
Queue = Annotated[
    str | None,
    typer.Option(
        help="Readings that wait while a frame is computed: the latest, or all (in order, at most 256).",
        metavar="latest|all",
    ),
]
Stop = Annotated[
    str | None,
    typer.Option(
        help="When boards stop: slices (together) or own (each independently).", metavar="slices|own"
    ),
]
Boards = Annotated[
    str | None,
    typer.Option(
        help="Running boards, comma-separated, in the order of the partitions.",
        metavar="ENDPOINT,...",
    ),
]
ConnectTimeout = Annotated[float | None, _seconds("Seconds to reach the rosbridge server (10).")]
FirstDataTimeout = Annotated[float | None, _seconds("Seconds until the first reading (30).")]
PeerTimeout = Annotated[float | None, _seconds("Seconds to reach a local process or a board (10).")]
BoardTimeout = Annotated[
    float | None, _seconds("Seconds a board may take beyond max_cycles at its speed (5).")
]
StopTimeout = Annotated[float | None, _seconds("Grace period in seconds for processes to exit (5).")]
LogLevel = Annotated[
    str | None,
    typer.Option(
        help="Log level: info, warning, or debug (one line per frame).", metavar="info|warning|debug"
    ),
]
Count = Annotated[int | None, typer.Option("--count", "-n", min=1, help="Exit after this many.")]
