"""A publication that may lose messages: a sensor goes on measuring while the server is away."""

from collections.abc import Mapping
from typing import Any

from bridge.client import Publication
from bridge.errors import DisconnectedError, SlowPeerError
from casestudies.running import say


class LossyPublication:
    """Drops messages while the server is away or does not keep up, and says so once each time."""

    def __init__(self, publication: Publication) -> None:
        """Publish through this publication."""
        self._publication = publication
        self._away = False

    async def publish(self, message: Mapping[str, Any]) -> bool:
        """Publish the message, or drop it where nobody takes it; whether it was published."""
        try:
            await self._publication.publish(message)
        except (DisconnectedError, SlowPeerError) as error:
            if not self._away:
                say(f"warning: {error}; messages on {self._publication.topic} are dropped until it is back")
            self._away = True
        else:
            if self._away:
                say(f"{self._publication.topic} is published again")
            self._away = False
        return not self._away
