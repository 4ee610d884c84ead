"""The asyncio rosbridge client: topics and services over one connection that comes back by itself.

    async with connect("ws://127.0.0.1:9090") as ros:
        async for message in ros.subscribe("/boat/sensors", "boat_msgs/Sensors"):
            print(message.msg)

Everything that waits has a limit, everything that queues has a size, and what is lost is counted
(``docs/how-to/bridge.md``).
"""

import asyncio
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from ssl import SSLContext
from typing import Any, Final, Literal, Self

from bridge.client.goals import Goal
from bridge.client.handles import (
    PUBLISH_QUEUE_SIZE,
    QUEUE_SIZE,
    Handler,
    Publication,
    Service,
    Subscription,
    ask_rosapi,
)
from bridge.client.protocol import ClientCore, Compression, Delivery, RosVersion
from bridge.client.protocol.events import StatusReceived
from bridge.client.route import Path, make_route, shown
from bridge.client.session import Limits, Message, Session, State, StateCallback
from bridge.client.websocket import check_uri
from bridge.codecs.cbor_codec import Arrays
from bridge.codecs.json_codec import MAX_SIZE
from bridge.errors import OptionError
from bridge.names import ros_version_of_type
from bridge.qos import Qos

__all__ = ["Goal", "Message", "Publication", "Qos", "Ros", "Service", "State", "Subscription", "connect"]

#: Seconds that finding out the server's ROS version may take.
DETECT_TIMEOUT: Final = 2.0
#: Seconds that a server may take to show, before the client goes, that it has read everything.
FAREWELL_TIMEOUT: Final = 0.3


class Ros:
    """A client of one rosbridge server; `connect` makes it, ``async with`` opens and closes it, once."""

    def __init__(self, session: Session) -> None:
        """Stand on a session that is not open yet."""
        self._session = session
        self._publishes = False

    async def __aenter__(self) -> Self:
        await self._session.open()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection; what was published before still goes out. Everything that waits is ended.

        There are servers that drop what they have not yet read when a client goes. So a client that published
        first waits for an answer, which comes after all that it sent before; a third of a second at most.
        """
        try:
            if self._publishes and self._session.state is State.CONNECTED:
                await ask_rosapi(self._session, "get_time", {}, FAREWELL_TIMEOUT)
        finally:  # who is cancelled meanwhile is closed too
            await self._session.close()

    def together(self) -> AbstractContextManager[None]:
        """Have what is published inside leave in one piece: ``with ros.together(): ...``.

        Messages that belong together cost the server one awakening instead of one each. Nothing goes out before the
        block ends, so nothing else should be waited for in it.
        """
        return self._session.together()

    # How it stands

    @property
    def uri(self) -> str:
        """The server's URI."""
        return self._session.uri

    @property
    def state(self) -> State:
        """Where the connection stands."""
        return self._session.state

    @property
    def reconnections(self) -> int:
        """How often the connection was lost and came back."""
        return self._session.reconnections

    @property
    def last_error(self) -> str:
        """Why the connection was lost last, or why the last attempt to reconnect failed; empty if never."""
        return self._session.last_error

    @property
    def unusable(self) -> int:
        """How many messages arrived that no client can use."""
        return self._session.unusable

    @property
    def statuses(self) -> tuple[StatusReceived, ...]:
        """What the server said of itself lately, newest last. Most servers never do."""
        return tuple(self._session.statuses)

    async def wait_for_state(self, state: State, timeout: float) -> None:  # noqa: ASYNC109  # part of the error
        """Wait until the connection reaches a state; at once if it is there.

        Raises:
            StateTimeoutError: it did not in time.
            DisconnectedError: the client is or was closed meanwhile.
        """
        await self._session.wait_for_state(state, timeout)

    # Topics

    async def advertise(
        self,
        topic: str,
        type: str,  # noqa: A002  # ROS's word
        latch: bool = False,
        queue_size: int = PUBLISH_QUEUE_SIZE,
        *,
        qos: Qos | None = None,
    ) -> Publication:
        """Announce that messages will be published on a topic.

        A server over a real ROS tells its network first: subscribers there may miss what is published in the
        first tenths of a second.

        Args:
            topic: its name.
            type: the messages' type, in the form of ROS 1 or ROS 2.
            latch: whether the server keeps the last message for those who subscribe later; it is sent again
                after a reconnection.
            queue_size: how many messages may wait here for a slow server; told to the server too, for ROS.
            qos: what the server is to ask of ROS 2; older servers pass over it.

        Raises:
            NameFormError: of topic or type.
            TypeConflictError: this client advertises the topic already, as something else.
            OptionError: the queue has no room.
            DisconnectedError: the client was closed.
        """
        self._publishes = True
        return Publication(self._session, topic, type, latch=latch, queue_size=queue_size, qos=qos)

    def subscribe(
        self,
        topic: str,
        type: str | None = None,  # noqa: A002  # ROS's word
        *,
        throttle_rate: int = 0,
        queue_length: int = 0,
        queue_size: int = QUEUE_SIZE,
        compression: Compression = "none",
        arrays: Arrays = "list",
        fragment_size: int | None = None,
        qos: Qos | None = None,
    ) -> Subscription:
        """Subscribe to a topic.

        Args:
            topic: its name.
            type: the messages' type; None leaves it to the server, which is asked again every two seconds
                until a message comes, since servers forget subscriptions of topics they do not know yet.
            throttle_rate: milliseconds between two messages at least; the server drops what is between.
            queue_length: how many messages the server keeps instead of dropping them.
            queue_size: how many messages wait here for their reader; then the oldest is dropped and counted.
            compression: ``cbor`` brings long arrays at a tenth of JSON's time, ``cbor-raw`` the serialised
                bytes alone (`Message.raw`), ``png`` is for thin lines to servers of ROS 1. A server that does
                not know it sends JSON, or nothing.
            arrays: what arrays of numbers are in a message: ``list``, or ``numpy`` for NumPy's, read-only if
                they came as CBOR.
            fragment_size: characters of what the server may send in one piece.
            qos: what the server is to ask of ROS 2; older servers pass over it.

        Raises:
            NameFormError: of topic or type.
            TypeConflictError: this client subscribes to the topic already, as another type or in another form.
            OptionError: a number is out of its range.
            DisconnectedError: the client was closed.
        """
        return Subscription(
            self._session,
            topic,
            type,
            throttle_rate=throttle_rate,
            queue_length=queue_length,
            queue_size=queue_size,
            delivery=Delivery(compression=compression, arrays=arrays, fragment_size=fragment_size, qos=qos),
        )

    # Services

    async def call(
        self,
        service: str,
        args: Mapping[str, Any] | None = None,
        timeout: float = 5.0,  # noqa: ASYNC109  # part of the error
    ) -> Any:
        """Call a service.

        Args:
            service: its name.
            args: the request's fields.
            timeout: seconds for all of it.

        Returns:
            The answer's fields.

        Raises:
            ServiceError: it answered that it failed; with the server's text.
            NoAnswerError: it did not answer in time.
            SlowPeerError: the server did not even take the call in time.
            DisconnectedError: there is no connection, or it was lost meanwhile.
            EncodeError: the arguments cannot be sent as JSON.
        """
        return await self._session.call(service, args or {}, timeout)

    async def advertise_service(
        self,
        service: str,
        type: str,  # noqa: A002  # ROS's word
        handler: Handler,
        *,
        handler_timeout: float = 30.0,
    ) -> Service:
        """Serve a service.

        Args:
            service: its name.
            type: its type, in the form of ROS 1 or ROS 2.
            handler: is awaited with each request's fields and returns the answer's. If it raises `ServiceError`,
                the caller gets its reason; anything else is logged, and the caller gets the error's name.
                Requests are handled at the same time, 64 at most.
            handler_timeout: seconds that the handler may take for one request.

        Raises:
            NameFormError: of service or type.
            TypeConflictError: this client serves it already.
            DisconnectedError: the client was closed.
        """
        return Service(self._session, service, type, handler, handler_timeout)

    # Actions

    async def send_goal(
        self,
        action: str,
        type: str,  # noqa: A002  # ROS's word
        goal: Mapping[str, Any] | None = None,
        *,
        feedback: bool = True,
        timeout: float = 5.0,  # noqa: ASYNC109  # part of the error
    ) -> Goal:
        """Send a goal to an action of ROS 2.

        Args:
            action: its name.
            type: its type: ``example_interfaces/action/Fibonacci``, or without the middle.
            goal: the goal's fields.
            feedback: whether to be told how far it is.
            timeout: seconds that the server may take to read it.

        Returns:
            The goal on its way: ``async for feedback in goal``, ``await goal.result(timeout)``, and
            ``async with goal`` cancels it where it is left before its end.

        Raises:
            NameFormError: of action or type.
            SlowPeerError: the server did not take it in time, or too many goals are under way.
            DisconnectedError: there is no connection.
            EncodeError: the goal cannot be sent as JSON.
        """
        if self._session.must_wait():
            await self._session.wait_turn(f"a goal of {action}", timeout)
        return Goal(self._session, action, type, goal or {}, feedback=feedback)

    # Finding out about the server

    @property
    def ros_version(self) -> RosVersion | None:
        """Which ROS the server speaks for: as told, as detected, or as header stamps show; None if unknown."""
        return self._session.core.ros_version

    async def detect_ros_version(self, timeout: float = DETECT_TIMEOUT) -> RosVersion | None:  # noqa: ASYNC109  # all of it
        """Find out which ROS the server speaks for, if it can be found out.

        What was told to `connect` counts first, then the stamps of messages received so far, then rosapi: the
        version itself, or the form of the type of ``/rosout``. Later advertisements and subscriptions, and those
        restored after a reconnection, use type names of the form found.

        Args:
            timeout: seconds for all of it.

        Returns:
            1 or 2, None if it cannot be known: there is no rosapi, and no message with a header came yet.
        """
        if self.ros_version is None:
            questions = [
                asyncio.create_task(self._ask_version(timeout)),
                asyncio.create_task(self._ask_rosout_type(timeout)),
            ]
            try:
                for answer in asyncio.as_completed(questions):
                    self._session.core.wire.ros_version = await answer
                    if self.ros_version is not None:
                        break
            finally:
                for question in questions:
                    question.cancel()
        self._session.core.wire.ros_version = self.ros_version
        return self.ros_version

    async def _ask_version(self, limit: float) -> RosVersion | None:
        version = (await ask_rosapi(self._session, "get_ros_version", {}, limit)).get("version")
        return 1 if version == 1 else 2 if version == 2 else None

    async def _ask_rosout_type(self, limit: float) -> RosVersion | None:
        its_type = (await ask_rosapi(self._session, "topic_type", {"topic": "/rosout"}, limit)).get("type")
        return ros_version_of_type(its_type) if isinstance(its_type, str) else None


def connect(
    uri: str,
    *,
    connect_timeout: float = 10.0,
    ros_version: Literal["auto", "1", "2"] = "auto",
    token: str | None = None,
    headers: Mapping[str, str] | None = None,
    ca_file: Path | None = None,
    client_certificate: Path | tuple[Path, Path] | None = None,
    tls: SSLContext | None = None,
    proxy: str | None = None,
    max_size: int = MAX_SIZE,
    fragment_size: int | None = None,
    ping_interval: float = 5.0,
    ping_timeout: float = 5.0,
    on_state: StateCallback | None = None,
) -> Ros:
    """Make a client of a rosbridge server, which ``async with`` opens and closes.

    Entering fails if the first connection does, with `UnreachableError` or `NotRosbridgeError`. A connection lost
    later is opened again, first after 0.1 s, then after twice as long each time, 5 s at most, and everything that
    was advertised, subscribed and served is so again.

    Args:
        uri: ``ws://host:port``, or ``wss://`` for TLS, whose certificate is always checked.
        connect_timeout: seconds for the first connection.
        ros_version: whose form type names have on the wire. ``auto`` uses that of ROS 1, which servers of ROS 2
            take as well, until `Ros.detect_ros_version` has found it.
        token: is sent as ``Authorization: Bearer TOKEN``; like all headers it is in no log and no repr.
        headers: are sent when connecting.
        ca_file: certificates (PEM) that vouch for the server, instead of the system's.
        client_certificate: certificate and key (PEM) that this client shows, in one file or in two.
        tls: all of TLS, instead of these two.
        proxy: ``http://proxy:3128``, ``https://`` or ``socks5h://`` (with the package python-socks), or
            ``environment`` for the one that HTTPS_PROXY and the like name. None asks no proxy.
        max_size: bytes of one message at most, both ways. A larger one that arrives ends the connection.
        fragment_size: characters beyond which a message leaves in fragments; None for never.
        ping_interval: seconds of silence after which the server is asked for a sign of life.
        ping_timeout: seconds that it then has, before the connection counts as lost.
        on_state: is called with each new state and its reason.

    Raises:
        UriError: the URI is none of a WebSocket.
        OptionError: an option is out of its range, or a file cannot be read.
    """
    if ros_version not in {"auto", "1", "2"}:
        raise OptionError(f"ros_version must be auto, 1 or 2, not {ros_version!r}")
    limits = Limits(
        connect_timeout=connect_timeout,
        max_size=max_size,
        ping_interval=ping_interval,
        ping_timeout=ping_timeout,
    )
    told: RosVersion | None = None if ros_version == "auto" else 1 if ros_version == "1" else 2
    parsed = check_uri(uri)
    route = make_route(
        parsed,
        token=token,
        headers=headers,
        ca_file=ca_file,
        client_certificate=client_certificate,
        tls=tls,
        proxy=proxy,
    )
    core = ClientCore(ros_version=told, max_size=max_size, fragment_size=fragment_size)
    parsed = replace(parsed, username=None, password=None)  # the route has them
    return Ros(Session(parsed, shown(uri), core, limits, on_state, route=route))
