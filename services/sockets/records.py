"""What the services tell each other: the records that cross the local sockets.

Every record is a MessagePack array whose first element is its tag. Times called `*_ns` are Unix
time; those called `*_tick` are the machine's monotonic clock, comparable between its processes.
"""

from __future__ import annotations

import msgspec


class Record(msgspec.Struct, array_like=True, frozen=True):
    """Root of all records."""


class Hello(Record, tag="hello", frozen=True):
    """First record in each direction: who speaks, which version, for which model.

    `generation` is the master's to say: how often the run has changed its deployment. The service counts on from there.
    """

    role: str
    version: str
    deployment_hash: str
    generation: int = 0


class Begin(Record, tag="begin", frozen=True):
    """Master to a service: go ahead. `once`: this run ends after its first frame."""

    once: bool


class Ready(Record, tag="ready", frozen=True):
    """A service to the master: it has what it needs (a connection, an advertised topic, programmed boards)."""

    sentence: str


class Notice(Record, tag="notice", frozen=True):
    """A service to the master: something that the user should read, but that ends nothing.

    With `--log-level debug` the master sends one to the subscriber for each frame, which carries the frame's number.
    """

    level: str
    sentence: str


class Trouble(Record, tag="trouble", frozen=True):
    """A service to the master: it can't go on, and why."""

    exit_code: int
    sentence: str


Addresses = list[int | list[int] | None]
"""What a frame's readings became, in the order of the variables: an address, None for a missing one, or, where replicas or
lines have readings of their own, a row of them (row by row, -1 for a missing one)."""


class Reading(Record, tag="reading", frozen=True):
    """Subscriber to master: one complete set of addresses, in the order of the machine's columns.

    `addresses` holds None for a missing reading; `passed_over` counts the readings that the
    subscriber lost since the last one it sent, `unpaired` the messages whose partners on other topics did not come.
    `generation` is that of the deployment by which the addresses were made: the boards' tables have to be of the same.
    """

    stamp_ns: int
    received_ns: int
    received_tick: int
    sent_tick: int
    addresses: Addresses
    passed_over: int
    unpaired: int = 0
    prior_codes: bytes = b""
    generation: int = 0


class Unusable(Record, tag="unusable", frozen=True):
    """Subscriber to master: a message that makes no frame. Equal causes have equal `cause`."""

    cause: str
    sentence: str


class Frame(Record, tag="frame", frozen=True):
    """Master to pcie-app: compute this. `number` rises from 1 per master."""

    number: int
    addresses: Addresses
    bank: int
    prior_codes: bytes = b""


class BoardOutcome(Record, tag="board", frozen=True):
    """What one board returned: counts as little-endian uint32, one per line of its partition, replica after replica.

    Where there are several replicas each has its own cycles and reason; then `cycles` are those of the one that ran longest.
    """

    counts: bytes
    cycles: int
    reason: int
    replica_cycles: list[int] = []
    replica_reasons: list[int] = []


class FrameResult(Record, tag="result", frozen=True):
    """pcie-app to master: the boards' counts and where the time went."""

    number: int
    boards: list[BoardOutcome]
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


class Publish(Record, tag="publish", frozen=True):
    """Master to publisher: a result with the frame's own data."""

    result: FrameResult
    stamp_ns: int
    received_ns: int
    received_tick: int
    reading_sent_tick: int
    waited_ns: int


class Published(Record, tag="published", frozen=True):
    """Publisher to master: what became of a result.

    `outcome` is "published", "no posterior" or "rosbridge away"; `seen` says whether it was seen on
    the wire (None where nobody looked). `best_line` has `best_probability`; `total_ns` is the time
    from the reading's receipt to the result's sending. `missed` counts the outputs that it did not go to, of several,
    because their servers were away.
    """

    number: int
    outcome: str
    seen: bool | None
    best_line: int
    best_probability: float
    cycles: int
    total_ns: int
    missed: int = 0


class Prepare(Record, tag="prepare", frozen=True):
    """Master to a service: read this deployment, check it, and keep it ready; nothing changes yet."""

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
    """A service to the master: it could not prepare or switch, and goes on with what it had."""

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
