"""The envelope of a publish operation: the bytes before its message, which can be recognised later.

A publisher writes the same bytes before each message of a topic: `{"op":"publish","topic":"/t","msg":`. Once such
an envelope is proven, any data that starts with it, continues with one JSON object and ends with a brace is a publish
operation on that topic, and only the message itself has to be parsed.
"""

from typing import Any, Final

import orjson

_KEY: Final = b'"msg":'
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
