"""Command-line flags for the settings, generated from `Settings`, and further flags that several commands share."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer
from pydantic import ValidationError

from services.child import end_with_parent
from services.errors import SettingsError
from services.settings import ENV_PREFIX, Settings, load_settings
from terminal.flags import Group, expanded, flags_of
from toolchain.deployment import Deployment, Source


def with_settings(*names: str) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Return a decorator that adds flags for the settings `names`. The command gets all settings as `settings`."""

    def load(**flags: Any) -> Settings:
        end_with_parent()  # first, because the parent may have ended already
        # None means not given, so that its variable holds
        return load_settings(**flags)

    def decorate(command: Callable[..., int]) -> Callable[..., int]:
        return expanded(command, {"settings": Group(flags_of(Settings, names, prefix=ENV_PREFIX), load)})

    return decorate


def refuse_with_deployment(settings: Settings, flags: Mapping[str, str | None]) -> None:
    """Raise a SettingsError if flags that describe a topic are given with a deployment, which has its own topics."""
    given = [f"{flag} {value}" for flag, value in flags.items() if value]
    # if it were ignored, the command would use another topic than the user named
    if settings.deployment is not None and given:
        raise SettingsError(
            f"{given[0]} cannot be combined with a deployment; {settings.deployment} has its own: omit one of them"
        )


def source_of(uri: str, topic: str, type_: str) -> Source:
    """Return the topic that flags describe, or raise a SettingsError if a deployment could not contain this topic."""
    try:
        return Source(uri=uri, topic=topic, type=type_)
    except ValidationError as error:
        first = error.errors()[0]
        raise SettingsError(
            f"--{first['loc'][0]}: {str(first['msg']).removeprefix('Value error, ')}"
        ) from error


def results_of(settings: Settings, topic: str | None) -> tuple[Deployment | None, str | None, str]:
    """Return the deployment that the settings name, or None, and the URI and topic of the results.

    `settings.uri` and `topic` override the URI and topic of the deployment, unless they are None.
    """
    # here, because boards and `status` start without the bridge and deployments
    from posteriors.posterior import RESULTS_TOPIC
    from services.sockets.serving import deployment_for

    deployment = deployment_for(settings) if settings.deployment is not None else None
    if deployment is None:
        return None, settings.uri, topic or RESULTS_TOPIC
    # the other outputs have the same posteriors
    output = deployment.outputs[0]
    return deployment, settings.uri or deployment.output_uri(output), topic or output.topic


ResultsTopic: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Topic of the posteriors.", show_default="the deployment's, or /BMresults", metavar="TOPIC"
    ),
]
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
