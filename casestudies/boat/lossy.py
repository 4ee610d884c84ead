"""A publication that drops messages while the server is away, slow or refuses the topic, as a sensor does."""

import asyncio
from collections.abc import Mapping
from typing import Any, Final

from bridge.client import Publication, Ros
from bridge.errors import DisconnectedError, SlowPeerError
from bridge.names import same_type
from terminal.one_line import shown
from terminal.output import say

SETTLED_S: Final = 3.0
"""Seconds after which a server that does not know an advertised topic has refused it."""


async def report_refused(ros: Ros, topic: str, type_: str) -> None:
    """Warn if, according to rosapi, the server does not forward an advertised topic."""
    await asyncio.sleep(SETTLED_S)
    known = await ros.topic_type(topic)
    if known is None or (known and same_type(known, type_)):
        return
    package = type_.partition("/")[0]
    reason = f"it is {shown(known)} there" if known else f"does the server have {package}?"
    say(
        f"warning: the server rejects everything on {topic}, of type {type_}: {reason}; "
        "install the package on the robot, or publish arrays with --array"
    )


class LossyPublication:
    """A publication that drops messages while the server is away or slow, with one warning each time."""

    def __init__(self, publication: Publication) -> None:
        """Wrap a publication."""
        self._publication = publication
        self._slow = False

    async def publish(self, message: Mapping[str, Any]) -> bool:
        """Publish the message or drop it, and return whether it was published."""
        try:
            await self._publication.publish(message)
        except DisconnectedError:
            return False
        except SlowPeerError as error:
            if not self._slow:
                say(f"warning: {error}; messages on {self._publication.topic} are dropped until it keeps up")
            self._slow = True
            return False
        if self._slow:
            say(f"{self._publication.topic} is published again")
        self._slow = False
        return True
