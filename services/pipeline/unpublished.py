"""Topics that nobody publishes, and the topics of the server whose names resemble theirs."""

import asyncio
import difflib
from collections.abc import Callable
from typing import Final

from bridge.client import Ros
from bridge.names import absolute
from terminal.one_line import shown

AFTER: Final = 2.0
"""Seconds in which a publisher may appear before a mistyped name is suspected."""


async def report_unpublished(ros: Ros, topic: str, report: Callable[[str], None]) -> None:
    """Report a topic that has no publisher `AFTER` seconds from now, with the nearest names, if there is rosapi."""
    await asyncio.sleep(AFTER)
    if await ros.publishers(topic) != []:
        return  # or the server has no rosapi
    others = {name for name in await ros.topics() or [] if name != absolute(topic)}
    near = difflib.get_close_matches(absolute(topic), others, 3, 0.6)
    perhaps = f"; did you mean {' or '.join(shown(name) for name in near)}?" if near else ""
    report(f"{topic} has no publisher at {ros.uri} yet{perhaps}")
