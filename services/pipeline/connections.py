"""Connections to a deployment's rosbridge servers, and checks of the deployment's topics at the servers.

`connect_all` connects to each server once. The checks ask rosapi for the publishers and the types of topics. If a
server has no rosapi, only the server's status messages can show that it refused a topic.
"""

import asyncio
import contextlib
import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from bridge.client import Ros, State, connect
from bridge.errors import BridgeError
from bridge.names import absolute, same_type
from services.settings import Settings
from terminal.one_line import shown

OnState = Callable[[str, State, str], None]
"""Callback that gets a server's URI, the new state of the connection, and the reason for the change."""

AFTER: Final = 2.0
"""Seconds after which a topic without a publisher is reported."""
ROSAPI_TIME = 2.0
"""Seconds to wait for an answer of rosapi. Many servers lack rosapi. The topics of such servers are not checked."""
SETTLED_TIME = 3.0
"""If a server does not list an advertised topic after this many seconds, the topic counts as refused."""
CHECK_INTERVAL = 10.0


async def connect_all(
    stack: contextlib.AsyncExitStack,
    settings: Settings,
    uris: Iterable[str],
    by_uri: dict[str, Ros] | None = None,
    *,
    on_state: OnState | None = None,
    **options: Any,
) -> dict[str, Ros]:
    """Connect to each server once, and return the connections by URI.

    A URI in the settings replaces all URIs in `uris`. Each connection is added to `by_uri` before the server is
    reached, so that the status also names an unreachable server. `options` are further options of `connect`.

    Raises:
        BridgeError: A server is unreachable, is not a rosbridge server, or is a `robot:NAME` that nobody announces.
    """
    by_uri = {} if by_uri is None else by_uri
    for uri in uris:
        if (used := settings.uri or uri) not in by_uri:
            by_uri[used] = connect(
                used,
                connect_timeout=settings.connect_timeout,
                retry=True,
                ca_file=settings.ca,
                ros_version=settings.ros_version,
                # messages of this project need no check
                check_types=False,
                on_state=None if on_state is None else partial(on_state, used),
                **options,
            )
            # entered one after the other, so that an error names the first server that is missing
            await stack.enter_async_context(by_uri[used])
    return by_uri


def reconnect_now(rosbridges: Mapping[str, Ros]) -> None:
    """Try immediately to reconnect to all lost servers.

    When the subscriber is connected again, the master tells the publisher, which then calls this function. The
    subscriber does the same when the publisher is connected again.
    """
    for ros in rosbridges.values():
        ros.reconnect_now()


# --- topics of readings --------------------------------------------------------------------


async def report_unpublished(ros: Ros, topic: str, report: Callable[[str], None]) -> None:
    """After `AFTER` seconds, report a topic if rosapi knows no publisher of it. The report suggests similar names."""
    # a publisher that starts at the same time is not missing
    await asyncio.sleep(AFTER)
    if await ros.publishers(topic) != []:
        return  # or the server has no rosapi
    # a topic of the same name in another namespace is the usual mistake
    others = {name for name in await ros.topics() or [] if name != absolute(topic)}
    near = difflib.get_close_matches(absolute(topic), others, 3, 0.6)
    perhaps = f"; did you mean {' or '.join(shown(name) for name in near)}?" if near else ""
    report(f"{topic} has no publisher at {ros.uri} yet{perhaps}")


async def report_unused_clock(ros: Ros, topic: str, report: Callable[[str], None]) -> None:
    """After `AFTER` seconds, suggest --use-sim-time in a report if `topic` (`/clock`) has a publisher."""
    await asyncio.sleep(AFTER)
    if await ros.publishers(topic):
        report(f"{topic} is published at {ros.uri}: if it is a simulation, pass --use-sim-time")


async def check_types(topics: Iterable[tuple[Ros, str, str]]) -> None:
    """Raise a NotReceivableError if rosapi says that a topic is published with another type than the given type."""
    asked = list(topics)
    types = await asyncio.gather(*(ros.topic_type(topic, ROSAPI_TIME) for ros, topic, _ in asked))
    for known, (ros, topic, own) in zip(types, asked, strict=True):
        # a topic without a publisher may still get our type
        if known and not same_type(known, own) and await ros.publishers(topic) != []:
            raise NotReceivableError(f"{topic} is {shown(known[:80])} at {ros.uri}, not {own}; use that type")


# --- topics of results ---------------------------------------------------------------------


class NotReceivableError(BridgeError):
    """Raised if readings cannot be received from a topic, or if a server does not pass published messages on."""


@dataclass(frozen=True, slots=True)
class AdvertisedTopic:
    """A topic that was advertised at a server."""

    ros: Ros
    uri: str
    name: str
    type: str
    key: str = ""
    """Key in the deployment's section `[topics]` that switches the topic off. Empty if the topic is always on."""


def reported_refusals(topics: Iterable[AdvertisedTopic]) -> dict[str, str]:
    """Return, by topic name, the reasons that servers gave in status messages for refusing topics."""
    return {
        topic.name: f"{topic.name} cannot be received at {topic.uri}: {shown(status.text[:200])}; {_way_out(topic)}"
        for topic in topics
        for status in topic.ros.statuses
        if status.operation.startswith(f"advertise:{topic.name}:")
    }


async def refusals(topics: Iterable[AdvertisedTopic], *, settled: bool) -> dict[str, str]:
    """Ask rosapi which topics cannot be received, and return the reasons by topic name.

    `settled` says that the servers have had time to register the topics. An unknown topic then counts as refused.
    """
    asked = list(topics)
    found = await asyncio.gather(*(_refusal(topic, settled=settled) for topic in asked))
    return {topic.name: why for topic, why in zip(asked, found, strict=True) if why}


async def _refusal(topic: AdvertisedTopic, *, settled: bool) -> str:
    if topic.ros.state is not State.CONNECTED:
        return ""
    known = await topic.ros.topic_type(topic.name, ROSAPI_TIME)
    if known is None:
        # no rosapi, or no answer in time
        return ""
    if known and not same_type(known, topic.type):
        return (
            f"{topic.name} cannot be received at {topic.uri}: it is {known[:80]} there, not {topic.type}; "
            f"end the other publisher, or {_way_out(topic)}"
        )
    if not known and settled:
        return (
            f"{topic.name} cannot be received at {topic.uri}: the server does not know it although it was advertised; "
            f"does its topics_glob allow the topic, and does it have {topic.type.partition('/')[0]}?"
            + (f" Otherwise {_way_out(topic)}" if topic.key else "")
        )
    return ""


def _way_out(topic: AdvertisedTopic) -> str:
    """Return advice, for an error message, about a topic that cannot be received."""
    if topic.key:
        return f"set {topic.key} = false under [topics] in deployment.toml"
    return "choose another topic for the results"
