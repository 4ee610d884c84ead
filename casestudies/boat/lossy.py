"""A publication that may lose messages: a sensor goes on measuring while the server is away or slow."""

from collections.abc import Mapping
from typing import Any

from bridge.client import Publication
from bridge.errors import DisconnectedError, SlowPeerError
from terminal.output import say


class LossyPublication:
    """Drops messages while the server is away, which is said elsewhere, or does not keep up, which it says once each time."""

    def __init__(self, publication: Publication) -> None:
        """Publish through this publication."""
        self._publication = publication
        self._slow = False

    async def publish(self, message: Mapping[str, Any]) -> bool:
        """Publish the message, or drop it where nobody takes it; whether it was published."""
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
