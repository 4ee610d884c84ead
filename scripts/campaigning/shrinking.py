"""Search for the shortest failing schedule by delta debugging (Zeller and Hildebrandt's ddmin)."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

Part = TypeVar("Part")


async def shrink(
    parts: list[Part], fails: Callable[[list[Part]], Awaitable[bool]], *, seconds: float
) -> list[Part]:
    """Return the shortest failing list found within the time; the last part is first tried alone.

    Args:
        parts: A list that failed.
        fails: Function that returns whether a list fails.
        seconds: Time after which no further list is tried.
    """
    deadline = time.monotonic() + seconds
    if len(parts) > 1 and time.monotonic() < deadline and await fails(parts[-1:]):
        return parts[-1:]
    pieces = 2
    while len(parts) >= pieces:
        size = -(-len(parts) // pieces)
        for start in range(0, len(parts), size):
            if time.monotonic() > deadline:
                return parts
            rest = parts[:start] + parts[start + size :]
            if rest and await fails(rest):
                parts, pieces = rest, max(2, pieces - 1)
                break
        else:
            if size == 1:
                break
            pieces = min(len(parts), 2 * pieces)
    return parts
