"""Flags of the commands: those of settings, made from `Settings`, and others that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from services.child import end_with_parent
from services.settings import ENV_PREFIX, Settings, load_settings
from terminal.flags import Group, expanded, flags_of


def with_settings(*names: str) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Give a command the flags of the named settings; its parameter `settings` gets all settings."""

    def load(**flags: Any) -> Settings:
        end_with_parent()  # first, because the parent may have ended already
        # None means not given, so that its variable holds
        return load_settings(**flags)

    def decorate(command: Callable[..., int]) -> Callable[..., int]:
        return expanded(command, {"settings": Group(flags_of(Settings, names, prefix=ENV_PREFIX), load)})

    return decorate


Listen: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Endpoint at which to wait for a master (a board: for pcie-app or a loader).",
        metavar="unix:PATH|tcp://HOST:PORT",
    ),
]
TlsCert: TypeAlias = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Certificate (PEM), to serve wss:// and https://.")
]
TlsKey: TypeAlias = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Private key of the certificate (PEM).")
]
TokenFile: TypeAlias = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Accepted client tokens, one per line.")
]
Insecure: TypeAlias = Annotated[
    bool, typer.Option("--insecure", help="Permit an unprotected address that other machines can reach.")
]
Count: TypeAlias = Annotated[
    int | None,
    typer.Option("--count", "-n", min=1, help="Exit after this many results (subscriber: readings)."),
]
