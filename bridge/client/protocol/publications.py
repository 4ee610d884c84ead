"""Advertised topics of a client. All advertisements of a topic share one `advertise` operation to the server."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import encode
from bridge.codecs.message_check import Definitions, MessageCheck
from bridge.errors import EncodeError, TypeConflictError
from bridge.names import absolute, check_name, ros1_type, same_type, split_type
from bridge.qos import Qos


@dataclass(slots=True)
class _Advertised:
    """One topic on the wire, for one or more advertisements of this client."""

    # From the first advertisement. All others must agree, except for the queue size.
    topic: str
    type: str
    latch: bool
    queue_size: int
    qos: Qos | None
    wire_id: str
    # Beginning of its messages on the wire, which is always the same; they end with a brace.
    prefix: bytes
    # Numbers of the advertisements; never empty while the topic is advertised.
    holders: set[int] = field(default_factory=set)
    # The check of its type; None while the type is unknown.
    check: MessageCheck | None = None
    # Holders whose first message has not been checked yet; empty without a check.
    unchecked: set[int] = field(default_factory=set)
    # The last message of a latched topic, which a server forgets with the connection.
    latched: bytes | None = None


class Publications:
    """All advertisements of a client."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # By type in the form of ROS 1; empty for an unknown type, which is not asked for again.
        self._definitions: dict[str, Definitions] = {}
        # By absolute name, and by the number from `advertise`; all advertisements of a topic share an entry.
        self._advertised: dict[str, _Advertised] = {}
        self._advertisements: dict[int, _Advertised] = {}

    def restore(self) -> None:
        """Advertise all topics on a new connection, and repeat the last message of each latched topic."""
        for advertised in self._advertised.values():
            self._send_advertise(advertised)
            # A server that has refused its size would close the connection again.
            if advertised.latched is not None and len(advertised.latched) <= self._wire.sendable:
                self._wire.write_bytes(advertised.latched)

    def advertise(
        self,
        topic: str,
        type_name: str,
        *,
        latch: bool = False,
        queue_size: int = 100,
        qos: Qos | None = None,
    ) -> int:
        """Advertise a topic (see `bridge.client.Ros.advertise`), and return the advertisement's number."""
        check_name(topic)
        split_type(type_name)
        number = self._wire.number()
        key = absolute(topic)
        advertised = self._advertised.get(key)
        if advertised is None:
            prefix = b'{"op":"publish","topic":"%b","msg":' % topic.encode()
            wire_id = f"advertise:{topic}:{number}"
            self._advertised[key] = advertised = _Advertised(
                topic, type_name, latch, queue_size, qos, wire_id, prefix
            )
            self._set_check(advertised)
            self._send_advertise(advertised)
        elif not same_type(advertised.type, type_name) or advertised.latch != latch or advertised.qos != qos:
            raise TypeConflictError(
                f"topic {topic} is already advertised as {advertised.type}, latch={advertised.latch}, "
                f"qos={advertised.qos}; it cannot be advertised as {type_name}, latch={latch}, qos={qos} too"
            )
        advertised.holders.add(number)
        if advertised.check is not None:
            advertised.unchecked.add(number)
        self._advertisements[number] = advertised
        return number

    def _send_advertise(self, advertised: _Advertised) -> None:
        qos = {} if advertised.qos is None else {"qos": advertised.qos.as_operation()}
        self._wire.write(
            op="advertise",
            id=advertised.wire_id,
            topic=advertised.topic,
            type=self._wire.type_name(advertised.type),
            latch=advertised.latch,
            queue_size=advertised.queue_size,
            **qos,
        )

    def is_known(self, type_name: str) -> bool:
        """Return whether `define` was called for a type."""
        return ros1_type(type_name) in self._definitions

    def define(self, type_name: str, definitions: Definitions) -> None:
        """Store the definitions for a message type.

        If the definitions include the type itself, `publish` checks the next message of each advertisement of this
        type. After one valid message, the messages of the advertisement are no longer checked.
        """
        self._definitions[ros1_type(type_name)] = definitions
        for advertised in self._advertised.values():
            if same_type(advertised.type, type_name):
                self._set_check(advertised)

    def _set_check(self, advertised: _Advertised) -> None:
        name = ros1_type(advertised.type)
        definitions = self._definitions.get(name, {})
        if name in definitions:
            advertised.check = MessageCheck(name, definitions)
            advertised.unchecked = set(advertised.holders)

    def publish(self, advertisement: int, msg: Mapping[str, Any]) -> bytes:
        """Check and encode a message of an advertised topic. The caller must send the returned bytes."""
        advertised = self._advertisements[advertisement]
        prefix = advertised.prefix
        try:
            if (
                advertised.unchecked
                and advertised.check is not None
                and advertisement in advertised.unchecked
            ):
                advertised.check(msg)
                advertised.unchecked.discard(advertisement)
            body = encode(
                msg, max_size=self._wire.sendable - len(prefix) - 1, max_depth=self._wire.max_depth - 1
            )
        except EncodeError as error:
            raise type(error)(f"a message of {advertised.topic} cannot be published: {error}") from None
        # Only the body is encoded, so that the paths in errors are those of the message.
        data = prefix + body + b"}"
        if advertised.latch:
            advertised.latched = data
        return data

    def unadvertise(self, advertisement: int) -> None:
        """End an advertisement. If it was the topic's last advertisement, withdraw the topic from the server."""
        advertised = self._advertisements.pop(advertisement)
        advertised.holders.discard(advertisement)
        advertised.unchecked.discard(advertisement)
        if not advertised.holders:
            del self._advertised[absolute(advertised.topic)]
            self._wire.write(op="unadvertise", id=advertised.wire_id, topic=advertised.topic)
