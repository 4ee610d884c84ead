"""Everything that can go wrong between this host and a rosbridge server, each as one sentence for the user.

``str(error)`` says what happened, where, what was expected and, where it helps, what to do. ``exit_code`` is
what a command ends with when the error ends it.

* `BridgeError`
    * `UriError`, `NameFormError`, `TypeConflictError`, `PathError`, `OptionError`,
      `ConcurrentReadError`, `EncodeError` (2: usage)
    * `UnreachableError`, `NotRosbridgeError`, `DisconnectedError` (3: the server is not there)
    * `AccessRefusedError` (2: it is there, and wants a token or a certificate)
    * `NoMessageError`, `NoAnswerError`, `SlowPeerError`, `StateTimeoutError` (3: a wait was in vain)
    * `ServiceError`, `GoalError` (3: a service or an action said no)
    * `DefinitionError` (2: a message's type is not known here, or rosbags is missing)
    * `DecodeError` (3: what arrived is no message)
    * `FieldMissingError`, `FieldAmbiguousError` (4: a variable cannot be found in a message)
"""

from typing import ClassVar


class BridgeError(Exception):
    """Root of all errors of ``bridge``."""

    exit_code: ClassVar[int] = 3


class UriError(BridgeError):
    """Raised when a URI is not one of a WebSocket (``ws://host:port`` or ``wss://host:port``)."""

    exit_code = 2


class NameFormError(BridgeError):
    """Raised when the name of a topic, a service or a type cannot be one in ROS."""

    exit_code = 2


class TypeConflictError(BridgeError):
    """Raised when one topic is advertised or subscribed twice by one client with different types."""

    exit_code = 2


class OptionError(BridgeError):
    """Raised when an option is out of its range (a rate, a queue's size, a time)."""

    exit_code = 2


class ConcurrentReadError(BridgeError):
    """Raised when two tasks wait on one subscription: each message would reach only one of them."""

    exit_code = 2


class EncodeError(BridgeError):
    """Raised when an object cannot leave as JSON (or CBOR): its type, a NaN, an infinity, its depth or its size."""

    exit_code = 2


class DecodeError(BridgeError):
    """Raised when bytes that arrived are no message within the limits of size and depth."""


class UnreachableError(BridgeError):
    """Raised when nothing answers at the URI: refused, no such host, no route, or no answer in time."""


class NotRosbridgeError(BridgeError):
    """Raised when something answers at the URI, but not as a WebSocket server does."""


class AccessRefusedError(BridgeError):
    """Raised when a server refuses this client: it wants a token or a certificate, or another one."""

    exit_code = 2


class DisconnectedError(BridgeError):
    """Raised when there is no connection now, or when it was lost while something waited on it."""


class StateTimeoutError(BridgeError):
    """Raised when a connection did not reach an awaited state in time."""


class NoMessageError(BridgeError):
    """Raised when no message of a subscribed topic arrived in time."""


class NoAnswerError(BridgeError):
    """Raised when a service did not answer in time."""


class SlowPeerError(BridgeError):
    """Raised when the server does not take what is published in time, or too much waits for it."""


class ServiceError(BridgeError):
    """Raised when a service answers ``result: false``, and raised by a handler that wants to answer so.

    Attributes:
        reason: the text that the service gave (or is to give), as it was.
    """

    def __init__(self, reason: str, service: str = "") -> None:
        """Keep the reason apart from the sentence: a served handler's reason goes onto the wire as it is."""
        self.reason = reason
        self.service = service
        where = f"service {service} refused the call" if service else "the call was refused"
        super().__init__(f"{where}: {reason or 'it gave no reason'}")


class GoalError(BridgeError):
    """Raised when an action takes no goal, or its goal ended without a result.

    Attributes:
        reason: the text that the server gave.
    """

    def __init__(self, reason: str, action: str) -> None:
        """Keep the reason apart from the sentence."""
        self.reason = reason
        super().__init__(f"action {action} has no result: {reason or 'it gave no reason'}")


class DefinitionError(BridgeError):
    """Raised when serialised bytes cannot be read: no definition of their type is known, or no library is there."""

    exit_code = 2


class PathError(BridgeError):
    """Raised when the path of a variable (``pose.position.x``, ``ranges[3]``) is not well-formed."""

    exit_code = 2


class FieldMissingError(BridgeError):
    """Raised when a message has not got the field; the sentence lists what it has."""

    exit_code = 4


class FieldAmbiguousError(BridgeError):
    """Raised when a bare name occurs more than once in a message; the sentence lists the places."""

    exit_code = 4
