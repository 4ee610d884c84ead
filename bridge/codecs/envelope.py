"""The envelope of a published message: what stands before it, known again when it comes again.

Who publishes on a topic says the same before each message: ``{"op":"publish","topic":"/t","msg":``. Once such an
envelope is proven, whatever begins with it, goes on with one JSON object and ends with a brace is a publish on that
topic: of all that comes in it, only the message itself must be looked at.
"""

from typing import Any, Final

import orjson

_KEY: Final = b'"msg":'
#: Bytes in which the end of an envelope is looked for.
LONGEST: Final = 512
#: What ends an operation.
BRACE: Final = ord("}")


def envelope_of(data: bytes) -> bytes:
    """What may be the envelope of an operation: all up to its first ``"msg":``, nothing without one."""
    at = data.find(_KEY, 0, LONGEST)
    return data[: at + len(_KEY)] if at > 0 else b""


def topic_of(envelope: bytes) -> str | None:
    """The topic of an envelope, None if it is none.

    It is one if it makes a publish with nothing but a topic and a message out of an empty message and a brace. The
    brace closes the operation, so what stands before it is the value of its last key. Neither ``op`` nor ``topic``
    has that value: the key is ``msg``, and another object in its place is the message as well.
    """
    try:
        operation: Any = orjson.loads(envelope + b"{}}")
    except orjson.JSONDecodeError:
        return None
    if type(operation) is not dict or len(operation) != 3 or operation.get("op") != "publish":
        return None
    topic = operation.get("topic")
    return topic if type(topic) is str and operation.get("msg") == {} else None
