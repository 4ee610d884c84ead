"""Errors of rosbridge connections, each with one sentence for the user.

`str(error)` states what happened, where it happened, and what was expected. Some errors add advice. If an error
ends a command, the command exits with the error's `exit_code`. Classes that are not listed inherit their code:

* `BridgeError`: 3, caused by the server or by its messages
    * `UsageError`: 2, caused by usage, configuration or credentials
    * `FieldMissingError`, `FieldAmbiguousError`: 4, a variable was not found in a message
"""

from typing import ClassVar


class BridgeError(Exception):
    """Base class of all errors of `bridge`."""

    exit_code: ClassVar[int] = 3


class UsageError(BridgeError):
    """Base class of errors caused by the caller or the configuration."""

    exit_code = 2


class UriError(UsageError):
    """Raised when a URI is not a WebSocket URI (`ws://host:port` or `wss://host:port`)."""


class NameFormError(UsageError):
    """Raised when the name of a topic, a service or a type is invalid in ROS."""


class TypeConflictError(UsageError):
    """Raised when a client uses a topic with different types or options, or serves one service or action twice."""


class OptionError(UsageError):
    """Raised when an option has an invalid value, names an unusable file, or conflicts with another option."""


class ConcurrentReadError(UsageError):
    """Raised when two tasks wait for messages of one subscription. Each message would reach only one task."""


class WrongThreadError(UsageError):
    """Raised when a client is used outside the thread of its event loop."""


class ActionlibError(UsageError):
    """Raised when an action of a ROS 1 server is used. This client does not support ROS 1 actions (actionlib)."""


class EncodeError(UsageError):
    """Raised when an object cannot be encoded, for example because it contains a NaN or is nested too deeply."""


class MessageTooLargeError(EncodeError):
    """Raised when a message to be sent is larger than the limit of this client, or the known limit of the server."""


class MessageTypeError(EncodeError):
    """Raised when a message does not fit its type, for example because of a misspelt field or a wrong array shape."""


class TopicLeftOutError(BridgeError):
    """Raised when a client no longer subscribes to a topic because the messages exceed the client's size limit."""


class DecodeError(BridgeError):
    """Raised when received bytes are not a valid message, or the message is too large or nested too deeply."""


class UnreachableError(BridgeError):
    """Raised when a URI is unreachable, for example because nothing answers in time or the host is unknown."""


class NotRosbridgeError(BridgeError):
    """Raised when a server does not answer like a WebSocket server, or does not speak TLS at a `wss://` URI."""


class AccessRefusedError(UsageError):
    """Raised when a server refuses this client because of the client's token, headers or certificate."""


class DisconnectedError(BridgeError):
    """Raised when there is no connection, or when the connection was lost while the caller waited."""


class StateTimeoutError(BridgeError):
    """Raised when a connection did not reach the awaited state in time."""


class NoMessageError(BridgeError):
    """Raised when no message of a subscribed topic arrived in time."""


class NoAnswerError(BridgeError):
    """Raised when a service did not answer in time, or a goal did not end in time."""


class SlowPeerError(BridgeError):
    """Raised when the server does not accept messages in time, or too many messages, calls or goals are pending."""


class ServiceError(BridgeError):
    """Raised when a service answers `result: false`. A handler raises a ServiceError to give this answer.

    Attributes:
        reason: The unchanged text of the answer.
    """

    def __init__(self, reason: str, service: str = "") -> None:
        """Store the reason apart from the error's sentence. A handler's reason is sent to the caller unchanged."""
        self.reason = reason
        where = f"service {service} refused the call" if service else "the call was refused"
        super().__init__(f"{where}: {reason or 'it gave no reason'}")


class GoalError(BridgeError):
    """Raised when an action refuses a goal, or the goal ends without a result.

    Attributes:
        reason: Explanation from the server.
    """

    def __init__(self, reason: str, action: str) -> None:
        self.reason = reason
        super().__init__(f"action {action} has no result: {reason or 'it gave no reason'}")


class PathError(UsageError):
    """Raised when the path of a variable (`pose.position.x`, `ranges[3]`) is not well-formed."""


class FieldMissingError(BridgeError):
    """Raised when a message does not have a field. The error lists the fields of the message."""

    exit_code = 4


class FieldAmbiguousError(BridgeError):
    """Raised when a name without a path fits several fields of a message. The error lists the paths of these fields."""

    exit_code = 4
