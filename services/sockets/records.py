"""Records between the services.

    subscriber            master                pcie-app             publisher
        │ ◀───── Hello ─────▶ │ ◀────── Hello ──────▶ │                    │
        │                     │ ◀─────────────── Hello ──────────────────▶ │
        │ ────── Ready ─────▶ │ ◀────── Ready ─────── │                    │
        │                     │ ◀─────────────── Ready ─────────────────── │
        │ ◀───── Begin ────── │ ──────────────── Begin ──────────────────▶ │
        │ ───── Reading ────▶ │ ─── FrameRequest ───▶ │                    │
        │                     │ ◀─── FrameResult ──── │                    │
        │                     │ ─────────────── Publish ─────────────────▶ │
        │                     │ ◀────────────── Published ──────────────── │
        │                     │ ◀───────────────── Seen ────────────────── │

Any service may send `Notice` at any time, and `Trouble` before it ends. `Unusable` replaces a `Reading`, and
`FrameFailed` replaces a `FrameResult`.

Every record is a MessagePack array. The first element of the array is the record's tag. The fields `stamp_ns` and
`received_ns` are Unix times. The other fields `*_ns` are durations. The fields `*_tick` and `ticks` are times of this
computer's monotonic clock, so all processes on the computer can compare them.
"""

from enum import StrEnum
from importlib.metadata import version

import msgspec

VERSION = version("rosbayes")
"""Version of this software, sent in every `Hello`. It must be the same on both sides of a local socket."""


# --- words that the user sees in `status`, in metrics and at the end of a run ----------------------


class LossReason(StrEnum):
    """Reason why a reading has no result on some or all topics, as `status` shows it."""

    PASSED_OVER = "passed over"
    """A newer reading replaced the reading (with `queue = latest`)."""
    UNPAIRED = "unpaired"
    """A message arrived, but no message of another topic arrived within the tolerance."""
    TOO_LARGE = "too large"
    """A message was larger than the limit of its topic (`topic_bytes`)."""
    UNUSABLE = "with an unusable variable"
    FAILED = "failed on a board"
    WITH_APP = "lost with pcie-app"
    WITH_PUBLISHER = "lost with the publisher"
    NO_POSTERIOR = "no posterior"
    ROSBRIDGE_AWAY = "rosbridge away"
    REFUSED = "refused by rosbridge"
    """The server does not forward the topic, because the topic has another type there or is not allowed."""
    SOME_TOPICS = "on some topics only"
    """The result was published, but not on the topics of every server."""


class Outcome(StrEnum):
    """Outcome of a result at the publisher."""

    PUBLISHED = "published"
    NO_POSTERIOR = "no posterior"
    ROSBRIDGE_AWAY = "rosbridge away"
    REFUSED = "refused by rosbridge"


class FailureReason(StrEnum):
    """Reason why the boards did not finish a frame."""

    FAILED = "failed"
    """A board failed while it computed the frame."""
    AWAY = "away"
    """A board that failed an earlier frame is not available again yet."""


# Arrays are shorter than maps and faster to decode. New fields go to the end, with a default.
class Record(msgspec.Struct, array_like=True, frozen=True):
    """Base class of all records."""


# --- any service -----------------------------------------------------------------------------------


class Hello(Record, tag="hello", frozen=True):
    """The first record in each direction. It names the sender's role, version and deployment."""

    role: str
    version: str
    deployment_hash: str


class Begin(Record, tag="begin", frozen=True):
    """The master tells a service that the run starts. With `once`, the run ends after the first frame."""

    once: bool


class Ready(Record, tag="ready", frozen=True):
    """A service tells the master that it has connected, advertised its topics, or programmed its boards."""

    sentence: str


class Rosbridge(Record, tag="rosbridge", frozen=True):
    """The subscriber or publisher tells the master whether it is connected to a rosbridge server now.

    If a service is connected again, the master tells the other service to reconnect at once.
    """

    connected: bool


class Notice(Record, tag="notice", frozen=True):
    """A service sends the master a message for the user. The run continues.

    In the other direction, the master sends the subscriber a `Notice` with the number of each frame, but only with
    `--log-level debug`. The subscriber writes this notice to its log.
    """

    level: str
    sentence: str


class Trouble(Record, tag="trouble", frozen=True):
    """A service tells the master why the service cannot continue."""

    exit_code: int
    sentence: str


# --- a frame, in the order of sending --------------------------------------------------------------

Addresses = list[int | list[int] | None]
"""Addresses of a frame's readings, in the order of the variables. None is a missing reading.

If replicas or lines have readings of their own, a variable has a flat list: the addresses of replica 0, then those of
replica 1, and so on. In a list, -1 is a missing reading.
"""

Values = list[float | str | None]
"""Received values of a frame's readings, in the order of the variables, for the report of the frame.

None stands for a missing reading, and for a reading that is an array.
"""


class Reading(Record, tag="reading", frozen=True):
    """The subscriber sends the master one complete set of addresses.

    `stamp_ns` is the newest stamp of the messages in the set, or the time of receipt if they have no stamps.
    `prior_codes` is the prior from a message, with two bytes per cell of each replica. An empty `prior_codes` selects
    the prior in the machine. `passed_over` is the number of messages that the subscriber has dropped since its last
    `Reading`. A dropped reading counts as one message for each topic. `unpaired` is the number of messages that have
    remained unpaired since that `Reading`.
    """

    # When it was read on the robot, when its last message arrived here, and when this record was sent.
    stamp_ns: int
    received_ns: int
    received_tick: int
    sent_tick: int = 0
    addresses: Addresses = []
    passed_over: int = 0
    unpaired: int = 0
    prior_codes: bytes = b""
    values: Values = []
    # Receipt of each variable's message; empty if all are of one message.
    ticks: list[int] = []


class Unusable(Record, tag="unusable", frozen=True):
    """The subscriber reports an unusable message to the master. Messages with the same flaw have the same `cause`."""

    cause: str
    sentence: str


class FrameRequest(Record, tag="frame", frozen=True):
    """The master asks pcie-app to compute a frame. Every master numbers its frames from 1."""

    number: int
    addresses: Addresses
    bank: int
    prior_codes: bytes = b""


class FrameResult(Record, tag="result", frozen=True):
    """pcie-app sends the master the boards' results, the durations, and the traffic on the links.

    `boards` is an encoded list of `machines.kind.BoardResult`. A master without a filter forwards it without decoding.
    """

    number: int
    boards: msgspec.Raw
    register_writes_ns: int
    compute_ns: int
    reads_ns: int
    boards_compute_ns: int
    link_bytes: int = 0
    link_transfers: int = 0


class FrameFailed(Record, tag="failed", frozen=True):
    """pcie-app reports a failed frame to the master."""

    number: int
    # The board that failed, and the exit code of a run that ends with this frame.
    board: int
    exit_code: int
    sentence: str
    reason: FailureReason


class Publish(Record, tag="publish", frozen=True):
    """The master sends the publisher a frame's result, and the data for the frame's report."""

    result: FrameResult
    # Times of its reading, for the report of the frame and its latency.
    stamp_ns: int
    received_ns: int
    received_tick: int
    reading_sent_tick: int
    # Time that the reading waited in the master for the boards.
    waited_ns: int
    # The readings, for the report; an array is one address, -1.
    addresses: list[int | None] = []
    values: Values = []
    ticks: list[int] = []


class Published(Record, tag="published", frozen=True):
    """The publisher tells the master the outcome of a result.

    `seen` is True if the result came back from the server, and None if that was not checked. `best_line` is the number
    of the most probable line. `total_ns` is the time from the reading's receipt to the result's sending. If the result
    was published on some outputs only, `missed` is the number of the other outputs. `out_ns` is the duration of
    publishing. If there is no posterior or a biased posterior, `why` is the sentence of the frame's report. `cause`
    lists the boards' stop reasons.
    """

    number: int
    outcome: Outcome
    seen: bool | None
    best_line: int
    best_probability: float
    cycles: int
    total_ns: int
    missed: int = 0
    out_ns: int = 0
    why: str = ""
    cause: str = ""


class Seen(Record, tag="seen", frozen=True):
    """With `--loop`, the publisher tells the master whether the server sent a published result back in time.

    If no result comes back in time, the publisher sends `Seen(False)`. If a result comes back after that, the
    publisher sends `Seen(True)`.
    """

    seen: bool


# What a decoder accepts, by tag; any other bytes are an error of the connection.
AnyRecord = (
    Hello
    | Begin
    | Ready
    | Rosbridge
    | Notice
    | Trouble
    | Reading
    | Unusable
    | FrameRequest
    | FrameResult
    | FrameFailed
    | Publish
    | Published
    | Seen
)
