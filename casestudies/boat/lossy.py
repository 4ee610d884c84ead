"""A publication that drops messages while the server is away or slow, as a sensor does."""

from collections.abc import Mapping
from typing import Any

from bridge.client import Publication
from bridge.errors import DisconnectedError, SlowPeerError
from terminal.output import say


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
