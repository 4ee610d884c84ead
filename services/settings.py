"""Settings of all services, each from a flag, a `BM_*` variable, the deployment or a default, in this order."""

import difflib
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from bridge.discovery import ROBOT, find_uri
from pcie_shim.endpoint import Endpoint, parse_endpoint
from pcie_shim.errors import PcieShimError
from pcie_shim.wires import LinkRate
from services.errors import SettingsError
from terminal.flags import Flag
from terminal.logs import LogFormat, use_log_format
from toolchain.deployment.sections import TOPIC_BYTES_MAX, TOPIC_BYTES_MIN

SHORTEST_S, LONGEST_S = 0.001, 86_400.0
"""Minimum and maximum timeout in seconds."""
Seconds = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
ENV_PREFIX = "BM_"
_DEPLOYMENTS = "the deployment's"


class Settings(BaseModel):
    """Settings of a user. If a setting is None or "", the deployment's value or the default behaviour applies."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

    # --- what is computed, and for whom ---
    deployment: Annotated[Path | None, Flag(("--deployment", "-d"), "DIR")] = Field(
        default=None, description="Folder written by `toolchain build`."
    )
    uri: Annotated[str | None, Flag(metavar="ws://HOST:PORT|robot:NAME", otherwise=_DEPLOYMENTS)] = Field(
        default=None, description="rosbridge server of readings and results."
    )
    ca: Annotated[Path | None, Flag(metavar="FILE", otherwise="the system's")] = Field(
        default=None, description="Certificates (PEM) that sign the certificate of a wss:// server."
    )
    ros_version: Literal["auto", "1", "2"] = Field(
        default="auto", description="Spelling of stamps and types: that of ROS 1 or 2."
    )
    use_sim_time: bool = Field(
        default=False,
        description="Measure the age of readings in the simulated time of /clock; a reading without a stamp gets the simulated time of its receipt.",
    )
    queue: Annotated[Literal["latest", "all"] | None, Flag(otherwise=_DEPLOYMENTS)] = Field(
        default=None,
        description="Readings that wait while a frame is computed: the latest, or all in order, up to 256.",
    )
    message_bytes: int = Field(
        default=16 << 20,
        ge=1 << 10,
        le=1 << 28,
        description="Largest message of a topic, in bytes; a larger one ends the connection.",
    )
    topic_bytes: Annotated[int | None, Flag(otherwise=_DEPLOYMENTS)] = Field(
        default=None,
        ge=TOPIC_BYTES_MIN,
        le=TOPIC_BYTES_MAX,
        description="Largest message of each topic that is read, in bytes; larger ones are discarded and counted.",
    )

    # --- the boards ---
    boards: Annotated[tuple[str, ...], Flag(metavar="ENDPOINT,...|unix:DIR/", otherwise=_DEPLOYMENTS)] = (
        Field(
            default=(),
            description="Running boards, comma-separated in the order of the partitions, or the folder of `board --directory`.",
        )
    )
    stop: Annotated[Literal["slices", "own"] | None, Flag(otherwise=_DEPLOYMENTS)] = Field(
        default=None, description="When boards stop: slices (together) or own (each independently)."
    )
    key_file: Annotated[Path | None, Flag(metavar="FILE")] = Field(
        default=None, description="File with the key that boards over TCP and their hosts share."
    )

    link_rate: LinkRate = Field(
        default=LinkRate.NONE,
        description="Delay the frames of the boards started here as PCIe (20,800 Mbps) or USB/JTAG (24 Mbps) would.",
    )

    read_results: bool = Field(
        default=False,
        description="Read the results of the boards started here from their registers, as on hardware, instead of taking them from their interrupts.",
    )

    # --- the processes of a run ---
    subscriber: str = Field(
        default="", description="Endpoint of a running subscriber (see `master --connect`)."
    )
    publisher: str = Field(
        default="", description="Endpoint of a running publisher (see `master --connect`)."
    )
    pcie_app: str = Field(default="", description="Endpoint of a running pcie-app (see `master --connect`).")
    fused: bool = Field(
        default=False,
        description="Run subscriber, publisher and pcie-app inside the master's process: fewer hops, the same results.",
    )
    run_directory: Annotated[
        Path | None, Flag(metavar="DIR", otherwise="$XDG_RUNTIME_DIR/rosbayes or /tmp/rosbayes-UID")
    ] = Field(default=None, description="Folder of the sockets of a run, which one master at a time can use.")

    # --- timeouts, in seconds ---
    connect_timeout: Seconds = Field(default=10, description="Seconds to reach the rosbridge server.")
    first_data_timeout: Seconds = Field(
        default=30, description="Seconds until the first reading (listen: the first result)."
    )
    peer_timeout: Seconds = Field(default=10, description="Seconds to reach a local process or a board.")
    board_timeout: Seconds = Field(
        default=5, description="Seconds that a board may take beyond the time for max_cycles at its speed."
    )
    seen_timeout: Seconds = Field(
        default=2, description="Seconds until the rosbridge server must send a published result back."
    )
    stop_timeout: Seconds = Field(
        default=5, description="Seconds in which processes must exit after SIGTERM."
    )
    restart_window: Seconds = Field(
        default=60,
        description="Seconds within which three restarts of a process, or three frames that fail on boards, are allowed.",
    )
    ready_timeout: Seconds = Field(
        default=10, description="Seconds without a frame after which a process is not ready."
    )

    # --- what a process reports ---
    metrics: Annotated[str, Flag(metavar="[HOST:]PORT")] = Field(
        default="",
        description="Serve metrics for Prometheus, on loopback unless a host is given; the processes of a master use the next ports.",
    )
    log_level: Literal["info", "warning", "debug"] = Field(
        default="info", description="Log level; debug logs one line per frame."
    )
    log_format: LogFormat = Field(
        default=LogFormat.TEXT, description="Lines on standard error: text, or JSON objects."
    )

    @field_validator("deployment", "ca", "key_file", "run_directory", mode="before")
    @classmethod
    def _no_directory(cls, value: object) -> object:
        # an empty variable means no folder, not the current one
        return value or None

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

    @field_validator("boards", "subscriber", "publisher", "pcie_app", "metrics")
    @classmethod
    def _endpoints(cls, value: str | tuple[str, ...], field: ValidationInfo) -> str | tuple[str, ...]:
        parse = metrics_endpoint if field.field_name == "metrics" else parse_endpoint
        try:
            for text in filter(None, (value,) if isinstance(value, str) else value):
                parse(text)
        except (PcieShimError, SettingsError) as error:
            raise ValueError(str(error)) from error
        return value


def load_settings(**flags: Any) -> Settings:
    """Return the settings from flags, environment variables and defaults.

    A flag that is not None overrides the environment variable. An environment variable overrides the default.

    Raises:
        SettingsError: A `BM_*` variable is unknown, or a value is invalid.
        BridgeError: The robot that `--uri` names does not announce itself.
    """
    # a misspelt variable would otherwise be ignored, for example in a unit file
    known = {ENV_PREFIX + name.upper() for name in Settings.model_fields}
    variables: dict[str, Any] = {}
    for name in sorted(os.environ):
        if not name.upper().startswith(ENV_PREFIX):
            continue
        variables[name.upper().removeprefix(ENV_PREFIX).lower()] = os.environ[name]
        if name.upper() not in known:
            near = difflib.get_close_matches(name.upper(), known, 1, 0.5)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(sorted(known))}"
            raise SettingsError(
                f"environment variable {name} is not a setting of rosbayes; {hint} (unset it, or rename it)"
            )
    # flags that were not given leave their variables in force
    given = {name: value for name, value in flags.items() if value is not None and value != ()}
    # of several mistakes the first is reported: the others may follow from it
    try:
        settings = Settings(**variables | given)
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
    # later children inherit the variable
    if "log_format" in given:
        use_log_format(settings.log_format)
    # a `robot:NAME` is looked up only by users of the server: a board would wait for a robot that it never contacts
    if "uri" in flags and settings.uri is not None:
        return settings.model_copy(update={"uri": find_uri(settings.uri, settings.connect_timeout)})
    return settings


def _expected(name: str, message: str) -> str:
    """Describe the expected value of a setting in words; for a timeout, with both limits."""
    known = Settings.model_fields.get(name)
    if known is not None and known.annotation is float:
        return f"expected seconds from {SHORTEST_S:g} to {LONGEST_S:g}"
    return message.removeprefix("Value error, ").replace("Input should be", "expected", 1)


def metrics_endpoint(text: str) -> Endpoint:
    """Parse an address `[HOST:]PORT`, or raise a SettingsError. An address without a host is on loopback."""
    try:
        return parse_endpoint(f"tcp://{text}" if ":" in text else f"tcp://127.0.0.1:{text}")
    except PcieShimError:
        raise SettingsError(
            "expected [HOST:]PORT, for example 9400 (on loopback) or 192.168.1.10:9400"
        ) from None


def endpoint_in(directory: Path, name: str) -> Endpoint:
    """Return the endpoint of a named local socket in a directory, or raise an EndpointError if its path is too long."""
    return parse_endpoint(f"unix:{directory.absolute() / name}.sock")
