"""Case studies, each with a model, a simulator or a data reader, and a page that describes it.

This module has their common errors, and the common flags of their commands.
"""

from typing import Annotated, ClassVar, Final

import typer

from bridge.discovery import find_uri


class CaseStudyError(Exception):
    """Base class of the case studies' errors; `str()` is one sentence that says what to do."""

    exit_code: ClassVar[int] = 2


class DataFileError(CaseStudyError):
    """A file of recorded data is missing or is not valid."""


Uri = Annotated[
    str,
    typer.Option(
        envvar="BM_URI", help="The rosbridge server.", metavar="ws://HOST:PORT|robot:NAME", callback=find_uri
    ),
]
DEFAULT_URI = "ws://127.0.0.1:9090"
FirstTimeout = Annotated[float, typer.Option(min=0.1, help="Seconds until the first result.")]
Timeout = Annotated[float, typer.Option(min=0.1, help="Seconds between two results.")]
KEPT: Final = 2000
"""Number of frames that a viewer keeps for pictures and numbers if it runs until Ctrl-C."""
Count = Annotated[
    int | None,
    typer.Option(
        min=1, help="Exit after this many results.", show_default=f"at Ctrl-C; the last {KEPT} are drawn"
    ),
]
