"""What a server's message means to a client: the events that the protocol core hands out."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple


class MessageReceived(NamedTuple):
    """A message of a subscribed topic: for which of this client's subscriptions (a tuple: made in a third of the time)."""

    topic: str
    msg: dict[str, Any]
    subscriptions: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class CallAnswered:
    """A service answered: its values, or the text with which it refused."""

    call: str
    ok: bool
    values: Any


@dataclass(frozen=True, slots=True)
class ServiceRequested:
    """Someone calls a service of this client; `ClientCore.answer` takes the ticket back."""

    service: str
    args: dict[str, Any]
    ticket: int


@dataclass(frozen=True, slots=True)
class StatusReceived:
    """The server says something about an operation (few servers do)."""

    level: str
    text: str


@dataclass(frozen=True, slots=True)
class Unusable:
    """Something arrived that no client can use: one sentence says what."""

    reason: str


class GoalStatus(IntEnum):
    """How a goal of an action ended (``action_msgs/msg/GoalStatus``)."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


@dataclass(frozen=True, slots=True)
class GoalFeedback:
    """An action tells how far a goal of this client is."""

    goal: str
    values: Any


@dataclass(frozen=True, slots=True)
class GoalEnded:
    """A goal of this client is over: its status and result, or the text that says why there is none."""

    goal: str
    ok: bool
    status: GoalStatus
    values: Any


Event = (
    MessageReceived | CallAnswered | ServiceRequested | StatusReceived | GoalFeedback | GoalEnded | Unusable
)
