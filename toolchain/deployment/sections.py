"""The sections of `deployment.toml`, and the types of their values (thesis 3.3, 3.4). Each section is checked alone."""

import re
from collections import Counter
from enum import StrEnum
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Self, TypeAlias, TypeVar
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    FailFast,
    Field,
    Tag,
    model_validator,
)

from machines import KINDS
from machines.parameters import (
    COUNTER_BITS_MAX,
    CYCLES_MAX,
    REPLICAS_MAX,
    PriorMode,
    RngKind,
    RngReset,
    SampleEvery,
    SensorMode,
    Sequencer,
)

if TYPE_CHECKING:
    from machines.kind import MachineKind

NAME_MAX: Final = 200
"""Maximum number of characters in a name."""

_TYPE = re.compile(r"[A-Za-z]\w*/(?:msg/)?[A-Za-z]\w*")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_TOPIC = re.compile(r"/?[A-Za-z]\w*(?:/\w+)*")
MESSAGE_PATH = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z_][A-Za-z0-9_]*|\[[0-9]{1,9}\])*")


ROBOT: Final = "robot:"
"""Prefix of a URI that names a robot. The services look up the robot's address when they start."""


def websocket_uri(uri: str) -> str:
    """Return `uri` if it is a WebSocket URI or `robot:NAME`. Otherwise raise a ValueError."""
    if re.fullmatch(rf"{ROBOT}[0-9]+(/.*)?", uri):
        raise ValueError(f"{uri!r} would be a robot whose name is a number; did you mean 'ws://{uri}'?")
    if uri.startswith(ROBOT) and uri.removeprefix(ROBOT).strip() and uri.isprintable():
        return uri
    try:
        is_whole = bool(urlsplit(uri).hostname) and urlsplit(uri).port != 0
    except ValueError:  # a port beyond 65535, half an IPv6 address
        is_whole = False
    if not is_whole or not re.fullmatch(r"wss?://[^\s/?#]+\S*", uri):
        raise ValueError(
            f"{uri!r} is not a WebSocket URI; expected one like 'ws://robot:9090' (or {ROBOT}NAME)"
        )
    return uri


def _topic(topic: str) -> str:
    if not _TOPIC.fullmatch(topic):
        raise ValueError(f"{topic!r} is not a topic name; expected one like '/boat/sensors'")
    if not topic.startswith("/"):
        raise ValueError(
            f"{topic!r} does not begin with a slash; write '/{topic}', which means the same on every server"
        )
    return topic


def _matching(pattern: re.Pattern[str], what: str) -> AfterValidator:
    def check(text: str) -> str:
        if not pattern.fullmatch(text):
            raise ValueError(f"{text!r} is not {what}")
        return text

    return AfterValidator(check)


def _inside(name: str) -> str:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.name:
        raise ValueError(f"{name!r} must be a path inside the deployment's folder")
    return name


def _not_zero(step: float) -> float:
    if step == 0:
        raise ValueError("a step of 0 would give every value the same address")
    return step


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError(f"{name!r} has a character that cannot be printed")
    return name


WebSocketUri = Annotated[str, AfterValidator(websocket_uri)]
Topic = Annotated[str, AfterValidator(_topic)]
MessageType = Annotated[
    str, _matching(_TYPE, "a message type; expected one like 'std_msgs/Float64' or 'std_msgs/msg/Float64'")
]
_A_PATH = "a path in a message; expected one like 'pose.position.x', 'ranges[3]' or a field's name"
MessagePath = Annotated[str, _matching(MESSAGE_PATH, _A_PATH)]
PathOrName = Annotated[str, _matching(re.compile(f"(?:{MESSAGE_PATH.pattern})?"), _A_PATH)]
"""Path of a field in a message. If the path is empty, the message is searched for the name of the variable."""
Name = Annotated[str, Field(min_length=1, max_length=NAME_MAX), AfterValidator(_printable)]
"""A name of one printable line. Names are checked, because they may come from network files."""
Sha256 = Annotated[str, _matching(_SHA256, "a SHA-256 hash; expected 64 hexadecimal digits")]
OwnPath = Annotated[str, AfterValidator(_inside)]
"""Path of a file inside the folder of the deployment."""
Step = Annotated[float, AfterValidator(_not_zero)]
TOPIC_BYTES_MIN, TOPIC_BYTES_MAX = 1 << 10, 1 << 28
"""The smallest and the largest value of `topic_bytes`, the maximum size in bytes of a topic's message."""
TopicBytes = Annotated[int, Field(ge=TOPIC_BYTES_MIN, le=TOPIC_BYTES_MAX)]

Item = TypeVar("Item")
# TOML arrays and strings become tuples and enums; their contents stay strict.
Sequence = Annotated[tuple[Item, ...], Field(strict=False), FailFast()]
Choice = Annotated[Item, Field(strict=False)]
Unit = Annotated[
    str, Field(max_length=NAME_MAX, exclude_if=lambda unit: not unit), AfterValidator(_printable)
]
"""A unit such as m. An empty unit is omitted from `deployment.toml`."""
# empty states are omitted from the file and from its hash
States = Annotated[tuple[Name, ...], Field(strict=False, exclude_if=lambda states: not states)]


def states_fit(name: str, states: tuple[str, ...], size: int) -> None:
    """Raise a ValueError if the number of the variable's named states is neither 0 nor `size`."""
    if states and len(states) != size:
        raise ValueError(f"{name} has {size} values, but {len(states)} states are named")


def names_differ(kind: str, names: list[str]) -> None:
    """Raise a ValueError if two entries of a kind have equal names."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"[[{kind}]] has {twice[0]!r} twice; names must differ")


_WORD_MAX: Final = 2**32 - 1
"""Maximum value of a register."""
_INTERFACE: Final = re.compile(r"([1-9]\d{0,4})x([1-9]\d{0,5})")
_AN_INTERFACE: Final = "an interface; expected inputs x results, such as '20x1200'"


class Stop(StrEnum):
    """The stop rule for the boards of a partitioned machine."""

    SLICES = "slices"
    """A frame runs in slices. All boards stop at the end of the slice in which the first counter overflows."""
    OWN = "own"
    """Each board stops when one of its own counters overflows, as in the thesis."""


class Queue(StrEnum):
    """The rule for readings that wait, because they arrive faster than the boards compute frames."""

    LATEST = "latest"
    """Only the newest reading waits. Replaced readings are counted."""
    ALL = "all"
    """All readings wait, in order of arrival."""


class Scale(StrEnum):
    """The parts of a probability table that are scaled before quantising. Each part is divided by its maximum."""

    ADDRESS = "address"
    """Each row (the probabilities for one address) is a part. With this choice, a machine needs the fewest cycles."""
    COLUMN = "column"
    """The whole table of a column is one part. All rows are divided by one number, so their ratios stay the same."""
    NONE = "none"
    """No part is divided. The codes represent the raw probabilities."""


class Section(BaseModel):
    """Base class of all sections. It is frozen, refuses unknown keys, and does not convert `"8"` to an integer."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_by_name=True
    )

    def replace(self, **changes: Any) -> Self:
        """Return a copy with the given fields replaced, or raise a ValidationError."""
        return type(self)(**dict(self) | changes)


class ModelSection(Section):
    """`[model]`: the flags with which the build read the model. Later commands with `--model` use the same flags."""

    settings: Sequence[str] = ()
    bits: Sequence[str] = ()
    searched: str = ""
    known: str = ""
    given: Sequence[str] = ()
    prior_select: str = ""
    previous: str = ""
    on_missing: Literal["error", "missing"] = "error"


class Source(Section):
    """`[[source]]`: a topic of readings on a rosbridge server."""

    uri: WebSocketUri
    topic: Topic
    type: MessageType
    compression: Literal["none", "cbor"] = Field(default="none", exclude_if=lambda way: way == "none")
    topic_bytes: TopicBytes | None = Field(default=None, exclude_if=lambda size: size is None)


class Variable(Section):
    """`[[variable]]`: a known variable, and the conversion of its readings to addresses.

    A variable of kind `sensor` is a column of the machine. A variable of kind `prior_select` selects the row
    of the prior's table (thesis 2.1.2). If the reading of `prior_select` is missing, the last row of the
    prior's table applies. The last row is the prior that depends on no reading.
    """

    name: Name
    source: int = Field(default=0, ge=0)
    path: PathOrName = ""
    # the model's variable whose table the column has, if --order gave the column the readings of another
    table_of: Name | None = Field(default=None, exclude_if=lambda table: table is None)
    kind: Literal["sensor", "prior_select"] = "sensor"
    bits: int = Field(ge=1, le=16)
    offset: float = 0.0
    step: Step = 1.0
    unit: Unit = ""
    period: int | None = Field(default=None, ge=1)
    values: int = Field(ge=1)
    on_range: Literal["error", "clamp", "missing"] = "error"
    on_missing: Literal["error", "missing"] = "error"
    states: States = ()

    @model_validator(mode="after")
    def _addresses_fit(self) -> Self:
        if self.values > 2**self.bits - 1:
            bits = "1 bit holds" if self.bits == 1 else f"{self.bits} bits hold"
            raise ValueError(
                f"{self.name} serves {self.values} values, but {bits} {2**self.bits - 1} "
                "beside the address of a missing reading"
            )
        states_fit(self.name, self.states, self.values)
        return self


class Dimension(Section):
    """`[[searched]]`: a searched variable, as a dimension of the grid of lines. The first dimension varies slowest."""

    label: Name
    size: int = Field(ge=1)
    offset: float = 0.0
    step: Step = 1.0
    unit: Unit = ""
    states: States = ()

    @model_validator(mode="after")
    def _every_cell_has_a_name(self) -> Self:
        states_fit(self.label, self.states, self.size)
        return self

    def value(self, index: float) -> float:
        """Return the variable's value at an index. A whole index gives the centre of a cell."""
        return self.offset + index * self.step


class CommonSection(Section):
    """The keys of `[machine]` that every kind of machine has."""

    type: str
    lines: int = Field(ge=1)
    # the default of former builds, whose files may lack the key; a build writes it
    interface: Annotated[str, _matching(_INTERFACE, _AN_INTERFACE)] = "20x1200"
    prob_bits: int = Field(ge=1, le=16)

    @property
    def kind(self) -> "MachineKind":
        """The kind of the machine, BM1 or BM2, which defines what a frame and a result are."""
        return KINDS[self.type]()

    @property
    def interface_sensors(self) -> int:
        """The number of inputs for which a board has registers."""
        return parse_interface(self.interface)[0]

    @property
    def interface_results(self) -> int:
        """The number of results for which a board has registers."""
        return parse_interface(self.interface)[1]


class BM1Section(CommonSection):
    """`[machine]` of a BM1: its parameters, its interface, and its stop conditions."""

    type: Literal["BM1"] = "BM1"
    prob_bits: int = Field(default=8, ge=1, le=16)
    scale: Choice[Scale] = Field(default=Scale.ADDRESS, exclude_if=lambda scale: scale == Scale.ADDRESS)
    prior_bits: int = Field(default=0, ge=0, le=16)
    prior_mode: Choice[PriorMode] = PriorMode.TABLE
    counter_bits: int = Field(default=8, ge=1, le=32)
    rng: Choice[RngKind] = RngKind.LFSR32
    rng_banks: int = Field(default=16, ge=1)
    rng_reset: Choice[RngReset] = RngReset.BANK
    shared: bool = True
    steps_per_clock: int = Field(default=8, ge=1)
    target_count: int = Field(default=255, ge=1)
    max_cycles: int = Field(default=2**17, ge=1, le=CYCLES_MAX)
    stop: Choice[Stop] = Stop.SLICES
    sensor_mode: Choice[SensorMode] = Field(
        default=SensorMode.COLUMN, exclude_if=lambda mode: mode == SensorMode.COLUMN
    )
    replicas: int = Field(default=1, ge=1, le=REPLICAS_MAX, exclude_if=lambda replicas: replicas == 1)
    is_divided: ClassVar[bool] = True
    """True if each board has only a part of the lines, as in a BM1. False if each board has the whole machine."""
    stream: ClassVar = 0
    """Number of sampled states that a board buffers for publication. A BM1 samples no states."""
    variables: ClassVar[tuple[str, ...]] = ()
    """Names of the variables in a sampled state. A BM1 samples no states."""

    @model_validator(mode="after")
    def _target_fits(self) -> Self:
        if self.target_count > 2**self.counter_bits - 1:
            message = (
                f"target_count = {self.target_count} does not fit counters of {self.counter_bits} bits; "
                f"expected 1 to {2**self.counter_bits - 1}"
            )
            if (enough := self.target_count.bit_length()) <= COUNTER_BITS_MAX:
                message += f", or counters of {enough} bits (--counter-bits {enough})"
            raise ValueError(message)
        return self

    @property
    def reads_lines(self) -> bool:
        """True if every line of a column has its own reading."""
        return self.sensor_mode is not SensorMode.COLUMN

    @property
    def is_plain(self) -> bool:
        """True for a machine without replicas and with one reading per column. A result is then one posterior."""
        return self.replicas == 1 and not self.reads_lines

    @property
    def results(self) -> int:
        """The number of probabilities in the result of a frame: one for each line of each replica."""
        return self.replicas * self.lines


class BM2Section(CommonSection):
    """`[machine]` of a BM2: parameters, interface and stop conditions. Each board runs one chain."""

    type: Literal["BM2"] = "BM2"
    prob_bits: int = Field(default=16, ge=2, le=16)
    sequencer: Choice[Sequencer] = Sequencer.LINEAR
    literal: bool = False
    sample_every: Choice[SampleEvery] = SampleEvery.SWEEP
    burn_in: int = Field(default=1000, ge=0, le=_WORD_MAX)
    ops_timeout: int = Field(default=2**20, ge=1, le=_WORD_MAX)
    rng: Choice[RngKind] = RngKind.LFSR32
    rng_banks: int = Field(default=16, ge=1)
    rng_reset: Choice[RngReset] = RngReset.BANK
    steps_per_clock: int = Field(default=16, ge=1)
    target_count: int = Field(default=10_000, ge=1, le=_WORD_MAX)
    max_cycles: int = Field(default=2**28, ge=1, le=CYCLES_MAX)
    stream: int = Field(default=0, ge=0, le=_WORD_MAX)
    variables: Sequence[Name] = ()

    # settings that only a BM1 has, as in a BM1 that does not use them, so that no caller needs to ask for the kind
    scale: ClassVar = Scale.NONE
    prior_bits: ClassVar = 0
    prior_mode: ClassVar = PriorMode.TABLE
    stop: ClassVar = Stop.OWN
    sensor_mode: ClassVar = SensorMode.COLUMN
    counter_bits: ClassVar = 32
    replicas: ClassVar = 1
    reads_lines: ClassVar = False
    is_plain: ClassVar = True
    is_divided: ClassVar = False

    @property
    def results(self) -> int:
        """The number of probabilities in the result of a frame."""
        return self.lines


def _type_of(section: Any) -> Any:
    return section.get("type", "BM1") if isinstance(section, dict) else getattr(section, "type", "BM1")


MachineSection: TypeAlias = Annotated[
    Annotated[BM1Section, Tag("BM1")] | Annotated[BM2Section, Tag("BM2")], Discriminator(_type_of)
]
"""`[machine]` of a BM1 or a BM2. The key `type` selects the kind. Its default is BM1."""


class WrittenPrior(Section):
    """`[prior]`: the source and path of a prior that arrives in messages, and that the host writes to the boards.

    The prior is an array with one number for each line of the machine. Only the ratios of the numbers matter. Without
    this section, a machine with `prior_mode = written` uses the prior of its images until a host writes a prior.
    """

    source: int = Field(default=0, ge=0)
    path: MessagePath
    on_missing: Literal["error", "model"] = "error"


class FilterSection(Section):
    """`[filter]`: a filter (`deployment.filter`) that predicts a frame's prior from the previous frame's posterior."""

    file: OwnPath = "filter.npy"
    hash: Sha256


class BoardSection(Section):
    """`[[board]]`: a board of the mini-cluster, with its image and the lines that the board computes."""

    image: OwnPath
    image_hash: Sha256
    # the hash of the image as it was built, if another image was made since from edited sources
    built_hash: Sha256 | None = Field(default=None, exclude_if=lambda built: built is None)
    line_offset: int = Field(ge=0)
    lines: int = Field(ge=1)
    endpoint: str = ""


class Output(Section):
    """`[[output]]`: a topic of posteriors. If the URI is empty, the URI of the first source is used."""

    topic: Topic = "/BMresults"
    type: Literal["std_msgs/Float64MultiArray"] = "std_msgs/Float64MultiArray"
    uri: Annotated[str, AfterValidator(lambda uri: uri and websocket_uri(uri))] = ""


class TopicsSection(Section):
    """`[topics]`: whether to publish each topic for robot tools. None stands for the topic's default."""

    counts: bool | None = None
    posterior: bool | None = None
    pose: bool | None = None
    decision: bool | None = None
    diagnostics: bool | None = None


def parse_interface(text: str) -> tuple[int, int]:
    """Return the numbers of inputs and results of an interface like `20x1200` (thesis 3.2), or raise a ValueError."""
    match = _INTERFACE.fullmatch(text)
    if not match:
        raise ValueError(f"{text!r} is not {_AN_INTERFACE}")
    return int(match[1]), int(match[2])
