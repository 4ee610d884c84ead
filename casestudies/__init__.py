"""Case studies, each with a model, a simulator or a data reader, and a page that describes it.

This module defines the flags that the commands of several case studies have.
"""

import random
from typing import Annotated, Final

import typer

from bridge.discovery import find_uri


def _found(uri: str) -> str:
    return find_uri(uri)


Uri = Annotated[
    str,
    typer.Option(
        envvar="BM_URI", help="The rosbridge server.", metavar="ws://HOST:PORT|robot:NAME", callback=_found
    ),
]
DEFAULT_URI = "ws://127.0.0.1:9090"
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        help="Seed of what is simulated.",
        default_factory=lambda: random.SystemRandom().randrange(1_000_000),
        show_default="one is chosen and printed",
    ),
]
FirstTimeout = Annotated[float, typer.Option(min=0.1, help="Seconds until the first result.")]
Timeout = Annotated[float, typer.Option(min=0.1, help="Seconds between two results.")]
KEPT: Final = 2000
"""If a viewer runs until Ctrl-C, it keeps this many frames, the newest, for its pictures and statistics."""
Count = Annotated[
    int | None,
    typer.Option(
        min=1, help="Exit after this many results.", show_default=f"at Ctrl-C; the last {KEPT} are drawn"
    ),
]
