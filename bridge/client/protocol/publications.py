"""What a client publishes: several advertisements of one topic share one on the wire."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import encode
from bridge.errors import EncodeError, TypeConflictError
from bridge.names import absolute, check_name, same_type, split_type
from bridge.qos import Qos


@dataclass(slots=True)
class _Advertised:
    """One topic as advertised on the wire, for one or more advertisements of this client."""

    topic: str
    type: str
    latch: bool
    queue_size: int
    qos: Qos | None
    wire_id: str
    prefix: bytes  # of its messages on the wire; a brace completes them
    holders: set[int] = field(default_factory=set)
    latched: bytes | None = None  # the last message, said again after a reconnection


class Publications:
    """All that a client advertises."""

    def __init__(self, wire: Wire) -> None:
        """Begin with nothing advertised."""
        self._wire = wire
        self._max_size = wire.max_size
        self._max_depth = wire.max_depth
        self._advertised: dict[str, _Advertised] = {}
        self._advertisements: dict[int, _Advertised] = {}

    def restore(self) -> None:
        """Say all of it to a server that has heard none of it, and each latched topic's last message."""
        for advertised in self._advertised.values():
            self._say(advertised)
            if advertised.latched is not None:
                self._wire.put(advertised.latched)

    def advertise(
        self,
        topic: str,
        type_name: str,
        *,
        latch: bool = False,
        queue_size: int = 100,
        qos: Qos | None = None,
    ) -> int:
        """Want to publish on a topic.

        Args:
            topic: its name.
            type_name: in the form of ROS 1 or of ROS 2.
            latch: the server keeps the last message for those who subscribe later.
            queue_size: messages that the server holds for ROS's transport.
            qos: what the server is to ask of ROS 2.

        Returns:
            The advertisement's number, for `publish` and `unadvertise`.

        Raises:
            NameFormError: of topic or type.
            TypeConflictError: this client advertises the topic already, as something else.
        """
        check_name(topic)
        split_type(type_name)
        number = self._wire.number()
        key = absolute(topic)
        advertised = self._advertised.get(key)
        if advertised is None:
            prefix = b'{"op":"publish","topic":"%b","msg":' % topic.encode()
            wire_id = f"advertise:{topic}:{number}"
            advertised = _Advertised(topic, type_name, latch, queue_size, qos, wire_id, prefix)
            self._advertised[key] = advertised
            self._say(advertised)
        elif not same_type(advertised.type, type_name) or advertised.latch != latch or advertised.qos != qos:
            raise TypeConflictError(
                f"topic {topic} is already advertised as {advertised.type}, latch={advertised.latch}, "
                f"qos={advertised.qos}; it cannot be advertised as {type_name}, latch={latch}, qos={qos} too"
            )
        advertised.holders.add(number)
        self._advertisements[number] = advertised
        return number

    def _say(self, advertised: _Advertised) -> None:
        qos = {} if advertised.qos is None else {"qos": advertised.qos.as_operation()}
        self._wire.say(
            op="advertise",
            id=advertised.wire_id,
            topic=advertised.topic,
            type=self._wire.type_name(advertised.type),
            latch=advertised.latch,
            queue_size=advertised.queue_size,
            **qos,
        )

    def publish(self, advertisement: int, msg: Mapping[str, Any]) -> bytes:
        """Write one message of an advertised topic; the bytes are for the wire at once, not for the outbox.

        Raises:
            EncodeError: the message cannot leave as JSON; a NaN or an infinity is named with its place.
        """
        advertised = self._advertisements[advertisement]
        prefix = advertised.prefix
        try:
            body = encode(
                msg,
                nonfinite="refuse",
                max_size=self._max_size - len(prefix) - 1,
                max_depth=self._max_depth - 1,
            )
        except EncodeError as error:
            raise EncodeError(f"a message of {advertised.topic} cannot be published: {error}") from None
        data = b"%b%b}" % (prefix, body)
        if advertised.latch:
            advertised.latched = data
        return data

    def unadvertise(self, advertisement: int) -> None:
        """Stop wanting to publish; the last advertisement of a topic takes it off the wire."""
        advertised = self._advertisements.pop(advertisement)
        advertised.holders.discard(advertisement)
        if not advertised.holders:
            del self._advertised[absolute(advertised.topic)]
            self._wire.say(op="unadvertise", id=advertised.wire_id, topic=advertised.topic)
