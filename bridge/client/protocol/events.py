"""Events that the client's protocol core makes from messages of the server."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

from bridge.errors import DecodeError


class Message(NamedTuple):
    """One message of a topic.

    Attributes:
        topic: Name of the topic in the server's spelling.
        msg: The ROS message. Do not modify it, because all subscriptions of the topic share it.
        received_ns: `time.time_ns()` at arrival. Messages that arrive together have equal times.
        received_monotonic_ns: `time.monotonic_ns()` at arrival.
    """

    topic: str
    msg: dict[str, Any]
    received_ns: int
    received_monotonic_ns: int

    @property
    def raw(self) -> bytes:
        """The serialised bytes of a message of a `cbor-raw` subscription.

        Raises:
            DecodeError: The message has no serialised bytes, because the subscription or the server does not use
                `cbor-raw`.
        """
        data = self.msg.get("bytes")
        if type(data) is not bytes:
            raise DecodeError(
                f"a message of {self.topic} has no serialised bytes: was it subscribed with "
                "compression='cbor-raw', and does the server support that?"
            )
        return data


class MessageReceived(NamedTuple):
    """A message of a topic, and the numbers (from `Subscriptions.subscribe`) of the subscriptions that receive it."""

    topic: str
    msg: dict[str, Any]
    subscriptions: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MessageDiscarded:
    """A message discarded because its size exceeds its topic's limit.

    `count` is the number of messages of this topic that have been discarded so far.
    """

    topic: str
    size: int
    limit: int
    count: int
    subscriptions: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class CallAnswered:
    """The answer to a service call. If `ok` is False, `values` is the text of the failure."""

    call: str
    ok: bool
    values: Any


@dataclass(frozen=True, slots=True)
class ServiceRequested:
    """A request to a service of this client. To answer the request, pass `ticket` to `ServedServices.answer`."""

    service: str
    args: dict[str, Any]
    ticket: int


@dataclass(frozen=True, slots=True)
class StatusReceived:
    """A status message about an operation. Few servers send status messages."""

    level: str
    text: str
    operation: str = ""
    """The id of the operation, or empty if the server does not send the id."""


@dataclass(frozen=True, slots=True)
class UnusableReceived:
    """An unusable message, with the reason as a sentence."""

    reason: str


class GoalStatus(IntEnum):
    """Status of an action goal (`action_msgs/msg/GoalStatus`)."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


@dataclass(frozen=True, slots=True)
class GoalFeedback:
    """Feedback of an action on a goal that this client sent."""

    goal: str
    values: Any


@dataclass(frozen=True, slots=True)
class GoalEnded:
    """The end of a goal that this client sent. `values` is the result or, if `ok` is False, the text of the failure."""

    goal: str
    ok: bool
    status: GoalStatus
    values: Any


@dataclass(frozen=True, slots=True)
class GoalRequested:
    """A goal sent to an action of this client."""

    action: str
    goal: str
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class CancelRequested:
    """The sender of a goal has cancelled the goal."""

    action: str
    goal: str


Event = (
    MessageReceived
    | MessageDiscarded
    | CallAnswered
    | ServiceRequested
    | StatusReceived
    | GoalFeedback
    | GoalEnded
    | GoalRequested
    | CancelRequested
    | UnusableReceived
)
