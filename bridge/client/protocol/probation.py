"""The search for the topic whose messages are too large for the connection, which each of them ends."""

from collections.abc import Sequence
from typing import Final

FIRST_PATIENCE: Final = 1.0
"""Seconds for which a suspect may be silent before the next one is subscribed too."""
MAX_PATIENCE: Final = 30.0
"""Longest such time, which doubles with each loss that identified no topic."""
_MAX_ROUNDS: Final = 10


class Probation:
    """The topics that are not subscribed now: suspects, which return one by one, and those that are left out.

    A topic is identified if the beginning of the message named it, or if it was the only subscribed one. It
    gets a second chance, because many topics are too large only once.
    """

    def __init__(self) -> None:
        self._held: list[str] = []
        self._heard: set[str] = set()
        self._warned: set[str] = set()
        self._left_out: set[str] = set()
        self._current: str | None = None
        self._rounds = 0

    @property
    def patience(self) -> float:
        """Seconds for which the last returned suspect may be silent."""
        return min(FIRST_PATIENCE * 2.0 ** (self._rounds - 1), MAX_PATIENCE)

    @property
    def is_settled(self) -> bool:
        """True if a message of the last returned suspect has arrived."""
        return self._current in self._heard

    def holds(self, topic: str) -> bool:
        """Return whether a topic must not be subscribed now."""
        return topic in self._left_out or topic in self._held

    def has_left_out(self, topic: str) -> bool:
        """Return whether a topic stays unsubscribed."""
        return topic in self._left_out

    def hear(self, topic: str) -> None:
        """Record a message of a topic that was not too large."""
        self._heard.add(topic)

    def blame(self, subscribed: Sequence[str], named: str | None, *, only_topics: bool) -> str | None:
        """Handle the loss of a connection because of a message that was too large.

        Args:
            subscribed: The topics that were subscribed.
            named: The topic at the beginning of the message, if it could be read.
            only_topics: Whether the message must have been one of a topic, and not an answer.

        Returns:
            The topic that is left out from now on, or None.
        """
        alone = subscribed[0] if len(subscribed) == 1 and only_topics else None
        culprit = named if named in subscribed else alone
        current, self._current = self._current, None
        if culprit is None:
            # The latest suspect comes first, and is then the only one that is subscribed.
            first = sorted(subscribed, key=lambda topic: (topic != current, topic in self._heard))
            self._held = first + self._held
            self._heard.clear()
            self._rounds = min(self._rounds + 1, _MAX_ROUNDS)
        elif culprit in self._warned or culprit == current == alone:
            self._left_out.add(culprit)
            self._rounds = 0
            return culprit
        else:
            self._warned.add(culprit)
        return None

    def release(self) -> str | None:
        """Return the next suspect to subscribe to; None after the last one."""
        self._current = self._held.pop(0) if self._held else None
        return self._current

    def forget(self, topic: str) -> None:
        """Forget a topic that has no subscription any more."""
        if topic in self._held:
            self._held.remove(topic)
        for topics in (self._heard, self._warned, self._left_out):
            topics.discard(topic)
