"""The envelope of a publish operation: the bytes before its message, which can be recognised later.

A publisher writes the same bytes before each message of a topic: `{"op":"publish","topic":"/t","msg":`. Once such
an envelope is proven, any data that starts with it, continues with one JSON object and ends with a brace is a publish
operation on that topic, and only the message itself has to be parsed.
"""

import re
from typing import Any, Final

import orjson

_KEY: Final = b'"msg":'
_JSON_TOPIC: Final = re.compile(rb'"topic":\s*"([^"]+)"')
_CBOR_TOPIC: Final = re.compile(rb"etopic(?:x(.)|[\x61-\x77])", re.DOTALL)
"""The key `topic` and the header of the text after it: its length is in the low bits, or in a byte of its own."""
_CBOR_LENGTH: Final = 0x1F
LONGEST: Final = 512
"""Maximum length of an envelope in bytes."""
BRACE: Final = ord("}")
"""The last byte of an operation."""


def envelope_of(data: bytes) -> bytes:
    """Return the candidate envelope of an operation: everything up to its first `"msg":`, or nothing."""
    at = data.find(_KEY, 0, LONGEST)
    return data[: at + len(_KEY)] if at > 0 else b""


def topic_of(envelope: bytes) -> str | None:
    """Return the topic of an envelope, or None if it is not one.

    It is an envelope if, completed by an empty message and a brace, it is a publish operation with only a
    topic and a message. The brace closes the operation, so the message is the value of its last key. Neither
    `op` nor `topic` has that value, so this key is `msg`, and any other object in its place is also the
    message.
    """
    try:
        operation: Any = orjson.loads(envelope + b"{}}")
    except orjson.JSONDecodeError:
        return None
    if type(operation) is not dict or len(operation) != 3 or operation.get("op") != "publish":
        return None
    topic = operation.get("topic")
    return topic if type(topic) is str and operation.get("msg") == {} else None


def topic_in(beginning: bytes) -> str | None:
    """Return the topic of a publish operation in JSON or CBOR of which only the beginning is known."""
    match = _JSON_TOPIC.search(beginning.split(b'"msg"', 1)[0])
    if match is not None:
        return match[1].replace(b"\\/", b"/").decode(errors="replace")
    match = _CBOR_TOPIC.search(beginning.split(b"cmsg", 1)[0])
    if match is None:
        return None
    length = match[1][0] if match[1] else match[0][-1] & _CBOR_LENGTH
    return beginning[match.end() : match.end() + length].decode(errors="replace")
