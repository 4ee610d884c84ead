"""Check that rosbridge servers forward results: rosapi reports the type of a topic after it was advertised."""

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass

from bridge.client import Ros, State
from bridge.errors import BridgeError
from bridge.names import same_type

ROSAPI_TIME = 2.0
"""Seconds in which a server may answer; many have no rosapi, and then nothing is known."""
SETTLED_TIME = 3.0
"""Seconds after which a server that knows nothing of an advertised topic has refused it."""
CHECK_INTERVAL = 10.0


class NotReceivableError(BridgeError):
    """Raised if the result of a run of one frame cannot be received."""


@dataclass(frozen=True, slots=True)
class AdvertisedTopic:
    """A topic that was advertised at a server."""

    ros: Ros
    uri: str
    name: str
    type: str


async def refusals(topics: Iterable[AdvertisedTopic], *, settled: bool) -> dict[str, str]:
    """Return, by topic, why topics cannot be received, according to rosapi.

    Args:
        topics: The topics.
        settled: Whether the servers have had time to register them.
    """
    asked = list(topics)
    found = await asyncio.gather(*(_refusal(topic, settled=settled) for topic in asked))
    return {topic.name: why for topic, why in zip(asked, found, strict=True) if why}


async def _refusal(topic: AdvertisedTopic, *, settled: bool) -> str:
    if topic.ros.state is not State.CONNECTED:
        return ""
    known = await topic.ros.topic_type(topic.name, ROSAPI_TIME)
    if known is None:
        return ""
    if known and not same_type(known, topic.type):
        return (
            f"{topic.name} cannot be received at {topic.uri}: it is {known[:80]} there, not {topic.type}; "
            "end the other publisher, or build with another output topic"
        )
    if not known and settled:
        return (
            f"{topic.name} cannot be received at {topic.uri}: the server does not know it although it was advertised; "
            f"does its topics_glob allow the topic, and does it have {topic.type.partition('/')[0]}?"
        )
    return ""
