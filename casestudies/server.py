"""The flag `--uri` of the case studies' commands."""

from typing import Annotated

import typer


def _find(uri: str) -> str:
    from bridge.discovery import find_uri

    return find_uri(uri)


Uri = Annotated[
    str,
    typer.Option(
        envvar="BM_URI",
        help="The rosbridge server.",
        metavar="ws://HOST:PORT|robot:NAME",
        callback=_find,
    ),
]
DEFAULT_URI = "ws://127.0.0.1:9090"
