"""The forms in which subscribers want a message: JSON, a PNG of it, CBOR, or CBOR around the serialised message.

A message is written once in each form, however many subscribers want it.
"""

from functools import lru_cache
from typing import Any, Final, Literal

import orjson

from bridge.codecs.png import encode as picture
from bridge.hub.delivery.definitions import Definitions
from bridge.hub.operations import RefusedError

Compression = Literal["none", "png", "cbor", "cbor-raw"]

#: Where one client's subscriptions of a topic differ, the last of these that one of them asks for counts, as on
#: the reference server.
COMPRESSIONS: Final[tuple[Compression, ...]] = ("none", "png", "cbor", "cbor-raw")


def compression_of(asked: object) -> Compression:
    """The form that an operation asks for. What nobody knows is plain JSON, as on the reference server."""
    return next((known for known in COMPRESSIONS if known == asked), "none")


def as_png(payload: bytes) -> bytes:
    """An operation (its JSON) in an operation ``png``."""
    return orjson.dumps({"op": "png", "data": picture(payload)})


def json_prefix(name: str) -> bytes:
    """The beginning of a message of topic ``name`` on the wire: its JSON and a brace complete it."""
    return b'{"op":"publish","topic":"%b","msg":' % name.encode()


#: Objects and arrays within each other in what the hub itself has read: more than it takes.
_DEEPEST: Final = 256
#: Bytes around a topic's name and a message's JSON.
AROUND: Final = len(json_prefix("")) + 1


class Message:
    """One published message, written in the forms that are wanted of it.

    Raises:
        RefusedError: (from `payload`) the form is not possible, as nobody knows the type.
        EncodeError: (from `payload`) the form is not possible, or larger than may be.
    """

    __slots__ = ("_definitions", "_made", "_max_size", "_time_ns", "_type", "data", "parsed")

    def __init__(
        self,
        data: bytes,
        parsed: dict[str, Any] | None,
        type_name: str,
        time_ns: int,
        definitions: Definitions,
        max_size: int,
    ) -> None:
        """Keep what all forms are made of.

        Args:
            data: the message as JSON.
            parsed: the same, None if nobody has parsed it yet.
            type_name: its type, or the empty string.
            time_ns: when it came (cbor-raw says so), nanoseconds since 1970.
            definitions: what is known of types.
            max_size: bytes on the wire at most.
        """
        self.data = data
        self.parsed = parsed
        self._type = type_name
        self._time_ns = time_ns
        self._definitions = definitions
        self._max_size = max_size
        self._made: dict[tuple[Compression, str], bytes] = {}

    def payload(self, compression: Compression, name: str) -> bytes:
        """The message on the wire in one form, under the name that a client knows its topic by."""
        made = self._made.get((compression, name))
        if made is None:
            made = self._made[compression, name] = self._write(compression, name)
        return made

    def _write(self, compression: Compression, name: str) -> bytes:
        if compression == "none":
            return b"%b%b}" % (json_prefix(name), self.data)
        if compression == "png":
            wrapped = as_png(self.payload("none", name))
            if len(wrapped) > self._max_size:
                raise RefusedError(f"a message of {name} as PNG has more than {self._max_size} bytes")
            return wrapped
        import cbor2

        if self.parsed is None:
            self.parsed = orjson.loads(self.data)
        if compression == "cbor-raw":
            seconds, nanoseconds = divmod(self._time_ns, 10**9)
            serialised = self._definitions.serialise(self._type, self.parsed)
            msg = cbor2.dumps({"secs": seconds, "nsecs": nanoseconds, "bytes": serialised})
        else:
            typed = self._definitions.typed(self._type, self.parsed)
            if typed is None:
                from bridge.codecs.cbor_codec import encode

                msg = encode(self.parsed, max_size=self._max_size, max_depth=_DEEPEST, pack_floats=True)
            else:  # of JSON, typed arrays and bytes: nothing that needs a second look
                msg = cbor2.dumps(typed)
        payload = _cbor_prefix(name) + msg
        if len(payload) > self._max_size:
            raise RefusedError(f"a message of {name} as CBOR has more than {self._max_size} bytes")
        return payload


@lru_cache(maxsize=1024)
def _cbor_prefix(name: str) -> bytes:
    """The beginning of a message of topic ``name`` as CBOR: a map of three, its last value yet to come."""
    import cbor2

    dumps = cbor2.dumps
    return b"\xa3" + b"".join(map(dumps, ("op", "publish", "topic", name, "msg")))
