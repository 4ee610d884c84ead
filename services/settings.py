"""Settings of all services, in one class: flag over `BM_*` variable over deployment over default."""

import asyncio
import difflib
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from pcie_shim.endpoint import Endpoint, parse_endpoint
from pcie_shim.errors import PcieShimError
from services.errors import SettingsError

SHORTEST_S, LONGEST_S = 0.001, 86_400.0
"""Shortest and longest timeout."""
Seconds = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
ENV_PREFIX = "BM_"
ROBOT = "robot:"
"""Prefix of a URI that names a robot instead of an address."""


class Settings(BaseSettings):
    """Settings of a user. A field of None or "" leaves the deployment's own value, or the default behaviour."""

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, extra="forbid", frozen=True)

    deployment: Path | None = Field(default=None, description="folder that `toolchain build` wrote")
    uri: str | None = Field(default=None, description="rosbridge server, instead of the deployment's")
    ros_version: Literal["auto", "1", "2"] = Field(
        default="auto", description="how time stamps and types are written"
    )
    queue: Literal["latest", "all"] | None = Field(
        default=None, description="what waits while a frame is computed"
    )
    stop: Literal["slices", "own"] | None = Field(default=None, description="when the boards stop")
    boards: Annotated[tuple[str, ...], NoDecode] = Field(
        default=(), description="endpoints of boards that already run, comma-separated"
    )
    key_file: Path | None = Field(default=None, description="file with the key that boards over TCP share")
    board_ca: Path | None = Field(
        default=None,
        description="certificates (PEM) that sign those of boards over TLS; the system's without it",
    )
    subscriber: str = Field(default="", description="endpoint of a subscriber that already runs")
    publisher: str = Field(default="", description="endpoint of a publisher that already runs")
    pcie_app: str = Field(default="", description="endpoint of a pcie-app that already runs")
    connect_timeout: Seconds = Field(default=10, description="seconds to reach the rosbridge server")
    first_data_timeout: Seconds = Field(default=30, description="seconds until the first reading")
    peer_timeout: Seconds = Field(default=10, description="seconds to reach a local process or a board")
    board_timeout: Seconds = Field(
        default=5, description="seconds a board may take beyond max_cycles at its speed"
    )
    stop_timeout: Seconds = Field(default=5, description="seconds a process has to end")
    seen_timeout: Seconds = Field(default=2, description="seconds until a result is seen on the wire")

    fused: bool = Field(
        default=False, description="subscriber, publisher and pcie-app inside the master's process"
    )
    run_directory: Path | None = Field(default=None, description="folder of the processes' status sockets")
    control_directory: Path | None = Field(
        default=None, description="folder of the master's control socket; the run directory without it"
    )
    ready_timeout: Seconds = Field(
        default=10, description="seconds without a frame after which a process is not ready"
    )
    log_level: Literal["debug", "info", "warning"] = Field(
        default="info", description="what is logged; debug has a line for every frame"
    )

    @field_validator(
        "deployment", "key_file", "board_ca", "run_directory", "control_directory", mode="before"
    )
    @classmethod
    def _no_directory(cls, value: object) -> object:
        return value or None  # an empty variable means none, not the current folder

    @field_validator("boards", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(part.strip() for part in value.split(",") if part.strip())
        return value

    @field_validator("uri")
    @classmethod
    def _uri(cls, value: str | None) -> str | None:
        if value is not None and not value.startswith(("ws://", "wss://", ROBOT)):
            raise ValueError(
                f"a rosbridge URI starts with ws:// or wss://, for example ws://192.168.1.10:9090 (or {ROBOT}NAME, as `discover` lists it)"
            )
        return value

    @field_validator("boards", "subscriber", "publisher", "pcie_app")
    @classmethod
    def _endpoints(cls, value: str | tuple[str, ...]) -> str | tuple[str, ...]:
        for text in (value,) if isinstance(value, str) else value:
            if text:
                try:
                    parse_endpoint(text)
                except PcieShimError as error:
                    raise ValueError(str(error)) from error
        return value


def load_settings(**flags: Any) -> Settings:
    """Return the settings: flags (those that are not None) over the environment over the defaults.

    Raises:
        SettingsError: A `BM_*` variable is unknown, or a value can't be used.
        BridgeError: --uri names a robot that does not announce itself.
    """
    known = {ENV_PREFIX + name.upper() for name in Settings.model_fields}
    for name in sorted(os.environ):
        if name.upper().startswith(ENV_PREFIX) and name.upper() not in known:
            near = difflib.get_close_matches(name.upper(), known, 1, 0.5)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(sorted(known))}"
            raise SettingsError(
                f"environment variable {name} is not a setting of rosbayes; {hint} (unset it, or rename it)"
            )
    given = {name: value for name, value in flags.items() if value is not None and value != ()}
    try:
        settings = Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0]) if first["loc"] else "?"
        where = (
            f"--{name.replace('_', '-')}"
            if name in given
            else f"environment variable {ENV_PREFIX}{name.upper()}"
        )
        reason = _expected(name, str(first["msg"]))
        raise SettingsError(f"{where}: {reason} (got {first.get('input')!r})") from error
    if "uri" in flags and settings.uri is not None and settings.uri.startswith(ROBOT):
        return settings.model_copy(update={"uri": _found(settings.uri.removeprefix(ROBOT))})
    return settings


def _expected(name: str, message: str) -> str:
    """Return what was expected of a setting: of a timeout both its limits."""
    known = Settings.model_fields.get(name)
    if known is not None and known.annotation is float:
        return f"expected seconds from {SHORTEST_S:g} to {LONGEST_S:g}"
    return message.removeprefix("Value error, ").replace("Input should be", "expected", 1)


def _found(robot: str) -> str:
    """Return the URI of a robot that announces its rosbridge server, or raise a BridgeError."""
    from bridge.discovery import resolve

    # in a thread, because the caller may have a loop
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(lambda: asyncio.run(resolve(robot))).result()


def endpoint_in(directory: Path, name: str) -> Endpoint:
    """Return the endpoint of a named local socket in a directory; a SettingsError if the path is too long for one."""
    try:
        return parse_endpoint(f"unix:{directory.absolute() / name}.sock")
    except PcieShimError as error:
        raise SettingsError(str(error)) from error
