"""Records that cross the local sockets between the services.

Every record is a MessagePack array whose first element is its tag. Times called `*_ns` are Unix
time; those called `*_tick` are the machine's monotonic clock, comparable between its processes.
"""

from enum import StrEnum
from importlib.metadata import version

import msgspec

VERSION = version("rosbayes")
"""Version that every greeting carries: both sides of a local socket have the same."""


class LossReason(StrEnum):
    """Reason why a reading has no result, or not everywhere, as `status` shows it."""

    PASSED_OVER = "passed over"
    """A newer reading took its place (`queue = latest`)."""
    UNPAIRED = "unpaired"
    """No message came on another topic within the tolerance."""
    UNUSABLE = "with an unusable variable"
    FAILED = "failed on a board"
    WITH_APP = "lost with pcie-app"
    WITH_PUBLISHER = "lost with the publisher"
    IN_RELOAD = "lost in a reload"
    NO_POSTERIOR = "no posterior"
    ROSBRIDGE_AWAY = "rosbridge away"
    SOME_TOPICS = "on some topics only"
    """Published, but not on the topics of a server that was away."""


class Outcome(StrEnum):
    """Fate of a result at the publisher."""

    PUBLISHED = "published"
    NO_POSTERIOR = "no posterior"
    """No line of the model counted."""
    ROSBRIDGE_AWAY = "rosbridge away"


class FailureReason(StrEnum):
    """Reason why the boards did not finish a frame."""

    FAILED = "failed"
    """A board failed while it computed the frame."""
    AWAY = "away"
    """A board that failed an earlier frame is not back yet."""


class Record(msgspec.Struct, array_like=True, frozen=True):
    """Root of all records."""


class Hello(Record, tag="hello", frozen=True):
    """First record in each direction: the sender's role, version and deployment.

    `generation` comes from the master: how often the run has changed its deployment. The service continues from there.
    """

    role: str
    version: str
    deployment_hash: str
    generation: int = 0


class Begin(Record, tag="begin", frozen=True):
    """Master to a service: begin. With `once` the run ends after its first frame."""

    once: bool


class Ready(Record, tag="ready", frozen=True):
    """A service to the master: it has what it needs (a connection, an advertised topic, programmed boards)."""

    sentence: str


class Notice(Record, tag="notice", frozen=True):
    """A service to the master: a message for the user that does not end the run.

    With `--log-level debug` the master sends one per frame to the subscriber, with the frame's number.
    """

    level: str
    sentence: str


class Trouble(Record, tag="trouble", frozen=True):
    """A service to the master: it can't go on, and why."""

    exit_code: int
    sentence: str


Addresses = list[int | list[int] | None]
"""Addresses of a frame's readings, in the order of the variables: one, None for a missing one, or, where replicas or lines
have readings of their own, a flat list (row by row, -1 for a missing one)."""


class Reading(Record, tag="reading", frozen=True):
    """Subscriber to master: one complete set of addresses, with the newest stamp or receipt.

    `prior_codes` is a written prior, two bytes per line (and replica); empty for the machine's own. `passed_over` counts
    the readings that the subscriber lost since the last one it sent, `unpaired` the messages without a partner on other
    topics. `generation` is that of the deployment by which the addresses were computed: boards need tables of the same.
    """

    stamp_ns: int
    received_ns: int
    received_tick: int
    sent_tick: int = 0
    addresses: Addresses = []
    passed_over: int = 0
    unpaired: int = 0
    prior_codes: bytes = b""
    generation: int = 0


class Unusable(Record, tag="unusable", frozen=True):
    """Subscriber to master: a message that can't become a frame. Equal causes have equal `cause`."""

    cause: str
    sentence: str


class Frame(Record, tag="frame", frozen=True):
    """Master to pcie-app: compute this. `number` rises from 1 per master."""

    number: int
    addresses: Addresses
    bank: int
    prior_codes: bytes = b""


class FrameResult(Record, tag="result", frozen=True):
    """pcie-app to master: the boards' results, and where the time went.

    `boards` is a list of `pcie_shim.host.frame.BoardResult`, which only its sender and the publisher read.
    """

    number: int
    boards: msgspec.Raw
    register_writes_ns: int
    compute_ns: int
    reads_ns: int
    boards_compute_ns: int


class FrameFailed(Record, tag="failed", frozen=True):
    """pcie-app to master: a frame that the boards did not finish."""

    number: int
    board: int
    exit_code: int
    sentence: str
    reason: FailureReason


class Publish(Record, tag="publish", frozen=True):
    """Master to publisher: a result with the frame's own data."""

    result: FrameResult
    stamp_ns: int
    received_ns: int
    received_tick: int
    reading_sent_tick: int
    waited_ns: int


class Published(Record, tag="published", frozen=True):
    """Publisher to master: the fate of a result.

    `seen` is whether it was seen on the wire (None if that was not checked). `best_line` has `best_probability`;
    `total_ns` is the time from the reading's receipt to the result's sending. `missed` counts the outputs, of several,
    whose servers were away.
    """

    number: int
    outcome: Outcome
    seen: bool | None
    best_line: int
    best_probability: float
    cycles: int
    total_ns: int
    missed: int = 0


class Prepare(Record, tag="prepare", frozen=True):
    """Master to a service: read and check this deployment, and keep it ready; nothing changes yet."""

    generation: int
    folder: str
    deployment_hash: str


class Prepared(Record, tag="prepared", frozen=True):
    """A service to the master: it has the deployment of this generation."""

    generation: int


class Switch(Record, tag="switch", frozen=True):
    """Master to a service: work by the deployment of this generation from now on (or again)."""

    generation: int


class Switched(Record, tag="switched", frozen=True):
    """A service to the master: all that it sends from now on is of this generation."""

    generation: int


class NotReloaded(Record, tag="not reloaded", frozen=True):
    """A service to the master: it could not prepare or switch, and keeps the deployment that it had."""

    generation: int
    exit_code: int
    sentence: str


AnyRecord = (
    Hello
    | Begin
    | Ready
    | Notice
    | Trouble
    | Reading
    | Unusable
    | Frame
    | FrameResult
    | FrameFailed
    | Publish
    | Published
    | Prepare
    | Prepared
    | Switch
    | Switched
    | NotReloaded
)
