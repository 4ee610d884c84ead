"""The asyncio rosbridge client: topics, services and actions over one connection with automatic reconnection.

    async with connect("ws://127.0.0.1:9090") as ros:
        async for message in ros.subscribe("/boat/sensors", "boat_msgs/Sensors"):
            print(message.msg)

Every wait has a timeout, every queue has a size, and losses are counted (`docs/how-to/bridge.md`).
"""

import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from ssl import SSLContext
from typing import Any, Final, Literal, Self

from websockets.uri import WebSocketURI

from bridge.client.actions import ActionServer, Goal, GoalHandler
from bridge.client.handles import PUBLISH_QUEUE_SIZE, QUEUE_SIZE, Handler, Publication, Service, Subscription
from bridge.client.protocol import ClientCore, Compression, Delivery, RosVersion
from bridge.client.protocol.events import StatusReceived
from bridge.client.route import Path, Route, make_route, shown
from bridge.client.session import Session, State, StateCallback
from bridge.client.type_checks import TypeChecks
from bridge.client.websocket import Limits, check_uri
from bridge.codecs.cbor_codec import Arrays
from bridge.codecs.json_codec import MAX_SIZE
from bridge.codecs.message_check import Definitions, definitions_from_rosapi
from bridge.discovery import ROBOT, announced_uri
from bridge.errors import ActionlibError, OptionError
from bridge.names import ros2_type, ros_version_of_type
from bridge.qos import Qos

DETECT_TIMEOUT: Final = 2.0
"""Timeout in seconds for detecting the ROS version of the server."""
FAREWELL_TIMEOUT: Final = 0.3
"""Maximum number of seconds for which `close` waits until the server has read all messages."""


class Ros:
    """A client of one rosbridge server. `connect` creates the client, and `async with` opens and closes it once."""

    def __init__(self, session: Session, *, check_types: bool = True) -> None:
        self._session = session
        # None if the program has switched the checks off.
        self._types = TypeChecks(session) if check_types else None
        # Whether anything was advertised; if so, `close` waits until the server has read the last messages.
        self._publishes = False

    async def __aenter__(self) -> Self:
        await self._session.open()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection after all published messages, and end everything that waits.

        Some servers drop unread messages when a client disconnects. If this client has published, it therefore
        calls a service of rosapi before it disconnects. The server answers after it has read all earlier messages.
        The client waits for the answer for at most 0.3 s.
        """
        try:
            if self._publishes and self._session.state is State.CONNECTED:
                await self._session.ask_rosapi("get_time", {}, FAREWELL_TIMEOUT)
        finally:  # a cancelled client is closed too
            await self._session.close()

    def together(self) -> AbstractContextManager[None]:
        """Collect the messages published in a block `with ros.together():`. Send them all when the block ends.

        Messages that belong together then wake up the server only once. Nothing is sent before the block ends, so the
        block should not wait for anything.
        """
        return self._session.together()

    # State

    @property
    def uri(self) -> str:
        """URI of the server."""
        return self._session.uri

    @property
    def state(self) -> State:
        """State of the connection."""
        return self._session.state

    @property
    def reconnections(self) -> int:
        """Number of completed reconnections."""
        return self._session.reconnections

    def reconnect_now(self) -> None:
        """If the connection is lost, try to reconnect at once, without waiting for the next regular attempt.

        For example, call this method when another program has just connected to the same server.
        """
        self._session.reconnect_now()

    @property
    def last_error(self) -> str:
        """Reason of the latest connection loss or failed attempt to connect, or "" if there was none."""
        return self._session.last_error

    @property
    def unusable(self) -> int:
        """Number of unusable messages received."""
        return self._session.unusable

    @property
    def statuses(self) -> tuple[StatusReceived, ...]:
        """Latest status messages of the server, newest last. Most servers send none."""
        return tuple(self._session.statuses)

    async def wait_for_state(self, state: State, timeout: float) -> None:
        """Wait until the connection is in `state`.

        Raises:
            StateTimeoutError: The connection did not reach `state` within `timeout` seconds.
            DisconnectedError: The client was closed.
        """
        await self._session.wait_for_state(state, timeout)

    # Topics

    async def advertise(
        self,
        topic: str,
        type: str,
        latch: bool = False,
        queue_size: int = PUBLISH_QUEUE_SIZE,
        *,
        qos: Qos | None = None,
    ) -> Publication:
        """Advertise a topic.

        With `connect(..., check_types=True)`, the client checks the first message of each publication before
        it sends the message. The client asks rosapi once for the definition of each type. If rosapi does not
        know the type but the ROS version is known, the definition comes from rosbags.

        A ROS server must first announce the topic to the ROS network. ROS subscribers may therefore miss
        messages of the first tenths of a second.

        Args:
            topic: Name of the topic.
            type: Type in the form of ROS 1 or ROS 2.
            latch: Whether the server stores the last message for later subscribers. After a reconnection, the
                client sends the last message again.
            queue_size: Maximum number of messages that wait for a slow server. The server is asked to use this
                queue size in ROS too.
            qos: Quality of service in ROS 2. Older servers ignore this option.

        Raises:
            NameFormError: The name or the type is malformed.
            TypeConflictError: This client already advertises the topic with other options.
            OptionError: The queue size is not positive.
            DisconnectedError: The client was closed.
        """
        # The publication exists before its type is known, so that two tasks may advertise at the same time.
        self._publishes = True
        publication = Publication(self._session, topic, type, latch=latch, queue_size=queue_size, qos=qos)
        if self._types is not None:
            await self._types.learn_message(type)
        return publication

    def subscribe(
        self,
        topic: str,
        type: str | None = None,
        *,
        throttle_rate: int = 0,
        queue_length: int = 0,
        queue_size: int = QUEUE_SIZE,
        compression: Compression = "none",
        arrays: Arrays = "list",
        fragment_size: int | None = None,
        qos: Qos | None = None,
        max_bytes: int | None = None,
    ) -> Subscription:
        """Subscribe to a topic.

        Args:
            topic: Name of the topic.
            type: Type of the messages, or None for any type. Without a type, the client repeats the subscription
                every two seconds until a message arrives, because servers drop subscriptions to unknown topics.
            throttle_rate: Minimum number of milliseconds between two messages. The server queues or drops the rest.
            queue_length: Maximum number of throttled messages that the server queues.
            queue_size: Maximum number of messages queued here. A full queue drops and counts its oldest message.
            compression: `cbor` needs a tenth of the time of JSON for long arrays. `cbor-raw` passes only the
                serialised bytes (`Message.raw`). A server without support for the value sends JSON, or nothing.
            arrays: Python type of arrays of numbers: `list`, or `numpy` for NumPy arrays. CBOR gives read-only
                NumPy arrays.
            fragment_size: Maximum number of characters that the server sends in one fragment.
            qos: Quality of service in ROS 2. Older servers ignore this option.
            max_bytes: Maximum size of a message in bytes. A larger message is discarded and counted
                (`Subscription.discarded`).

        Raises:
            NameFormError: The name or the type is malformed.
            TypeConflictError: This client already subscribes to the topic with another type, or with other options.
                Only `queue_size` may differ.
            OptionError: A number is out of its range.
            DisconnectedError: The client was closed.
        """
        return Subscription(
            self._session,
            topic,
            type,
            queue_size=queue_size,
            delivery=Delivery(
                throttle_rate=throttle_rate,
                queue_length=queue_length,
                compression=compression,
                arrays=arrays,
                fragment_size=fragment_size,
                qos=qos,
                max_bytes=max_bytes,
            ),
        )

    # Services

    async def call(self, service: str, args: Mapping[str, Any] | None = None, timeout: float = 5.0) -> Any:
        """Call a service.

        Before the first call of a service, the client asks rosapi for the type of the service. This may take
        two seconds in addition to `timeout`. If rosapi knows the type, the client checks each request before
        it sends the request.

        Args:
            service: Name of the service.
            args: Fields of the request.
            timeout: Timeout in seconds.

        Returns:
            Fields of the answer.

        Raises:
            ServiceError: The service refused the call; the error has the server's text.
            NoAnswerError: The service did not answer in time.
            SlowPeerError: The server did not accept the call in time.
            DisconnectedError: There is no connection, or the connection was lost during the call.
            MessageTypeError: The request has a field that the type does not have, or an array of another shape.
            EncodeError: The arguments cannot be sent as JSON.
        """
        if self._types is not None:
            await self._types.check_request(service, args or {}, timeout)
        return await self._session.call(service, args or {}, timeout)

    async def advertise_service(
        self, service: str, type: str, handler: Handler, *, handler_timeout: float = 30.0
    ) -> Service:
        """Serve a service.

        Args:
            service: Name of the service.
            type: Type of the service, in the form of ROS 1 or ROS 2.
            handler: Coroutine function that gets the fields of a request and returns the fields of the answer.
                If the handler raises a `ServiceError`, the caller gets the reason of the `ServiceError`. Any other
                error is logged, and the caller gets the name of the error. Up to 64 requests are handled
                concurrently.
            handler_timeout: Timeout of the handler in seconds.

        Raises:
            NameFormError: The name or the type is malformed.
            TypeConflictError: This client already serves this service.
            DisconnectedError: The client was closed.
        """
        served = Service(self._session, service, type, handler, handler_timeout)
        if self._types is not None:
            name = self._session.core.wire.type_name(type, "srv")
            served.check = await self._types.part("service_response", name)
        return served

    # Actions

    async def send_goal(
        self,
        action: str,
        type: str,
        goal: Mapping[str, Any] | None = None,
        *,
        feedback: bool = True,
        timeout: float = 5.0,
    ) -> Goal:
        """Send a goal to an action of ROS 2.

        Args:
            action: Name of the action.
            type: Type of the action, `example_interfaces/action/Fibonacci` or `example_interfaces/Fibonacci`.
            goal: Fields of the goal.
            feedback: Whether to receive feedback.
            timeout: Maximum time in seconds until the server has accepted the goal's message.

        Returns:
            The active goal. `async for feedback in goal` yields its feedback, and `await goal.result(timeout)`
            waits for its result. `async with goal` cancels the goal at the end of the block.

        Raises:
            NameFormError: The name or the type is malformed.
            ActionlibError: The server uses ROS 1, where actions are sets of topics.
            SlowPeerError: The server did not accept the message in time, or too many goals are active.
            DisconnectedError: There is no connection.
            MessageTypeError: The goal has a field that the type does not have, or an array of another shape.
            EncodeError: The goal cannot be sent as JSON.
        """
        # In order after earlier messages, because the call may depend on them.
        if self._session.must_wait():
            await self._session.wait_turn(f"a goal of {action}", timeout)
        await self._require_ros_2(action, min(timeout, DETECT_TIMEOUT))
        if self._types is not None:
            await self._types.check_goal(action, type, goal or {}, timeout)
        return Goal(self._session, action, type, goal or {}, feedback=feedback)

    async def _require_ros_2(self, action: str, limit: float = DETECT_TIMEOUT) -> None:
        if await self.detect_ros_version(limit) == 1:
            raise ActionlibError(
                f"{self.uri} is a ROS 1 server, whose action {action} is a set of topics that this client does not "
                "handle: use roslibpy's actionlib, or a ROS 2 server"
            )

    async def advertise_action(self, action: str, type: str, handler: GoalHandler) -> ActionServer:
        """Serve an action of ROS 2.

        Args:
            action: Name of the action.
            type: Type of the action: `example_interfaces/action/Fibonacci` or `example_interfaces/Fibonacci`.
            handler: Coroutine function that executes a goal. The client calls the handler with each goal, up to 64
                goals concurrently. The handler may send feedback, and should check whether the goal has been
                cancelled. If the handler returns without having ended the goal, the returned fields become the
                goal's result. The goal then counts as cancelled if the sender asked for that, and otherwise
                as succeeded. If the handler raises an error, the goal is aborted, and the error is logged. A
                result or feedback that does not fit the type is such an error. Handlers are cancelled when the
                connection is lost.

        Raises:
            NameFormError: The name or the type is malformed.
            ActionlibError: The server is a ROS 1 server. Actions of ROS 1 are topics.
            TypeConflictError: This client already serves this action.
            DisconnectedError: The client was closed.
        """
        await self._require_ros_2(action)
        server = ActionServer(self._session, action, type, handler)
        if self._types is not None:
            name = ros2_type(type, "action")
            server.result_check = await self._types.part("action_result", name)
            server.feedback_check = await self._types.part("action_feedback", name)
        return server

    # Information about the server

    @property
    def ros_version(self) -> RosVersion | None:
        """ROS version of the server, or None if it is unknown.

        The version was configured, detected, or seen in the stamps of message headers.
        """
        return self._session.core.ros_version

    async def detect_ros_version(self, timeout: float = DETECT_TIMEOUT) -> RosVersion | None:
        """Detect the ROS version of the server, if possible.

        The first source is the option of `connect`. The second source is the stamps of received messages. The last
        source is rosapi, with the type name of `/rosout` or the answer of `get_ros_version`. Later advertisements
        and subscriptions use type names of the detected version, also when a reconnection restores them.

        Returns:
            1 or 2, or None if the version is still unknown after `timeout` seconds. The version stays unknown if
            the server has no rosapi and no message with a header has arrived.
        """
        if self.ros_version is None:
            # The type of /rosout first: a ROS 1 server without `get_ros_version` logs an error when it is asked
            ends = time.monotonic() + timeout
            rosout = await self.topic_type("/rosout", timeout)
            version = None if rosout is None else ros_version_of_type(rosout)
            if rosout is not None and version is None and self.ros_version is None:
                left = max(0.0, ends - time.monotonic())
                known = (await self._session.ask_rosapi("get_ros_version", {}, left)).get("version")
                version = 1 if known == 1 else 2 if known == 2 else None
            self._session.core.wire.ros_version = version
        self._session.core.wire.ros_version = self.ros_version
        return self.ros_version

    async def topic_type(self, topic: str, timeout: float = 1.0) -> str | None:
        """Return the type of a topic at the server, or None if the server has no rosapi.

        If the server does not know the topic, the type is empty.
        """
        return await self._ask_type(timeout, "topic_type", topic=topic)

    async def topics(self, timeout: float = 1.0) -> list[str] | None:
        """Return the names of all topics at the server, or None if the server has no rosapi."""
        return await self._ask_names(timeout, "topics")

    async def publishers(self, topic: str, timeout: float = 1.0) -> list[str] | None:
        """Return the names of the nodes that publish a topic, or None if the server has no rosapi."""
        return await self._ask_names(timeout, "publishers", topic=topic)

    async def message_details(self, type: str, timeout: float = 1.0) -> Definitions:
        """Return the fields of a message type and of all nested types, by ROS 1 type name.

        The result is empty if the server has no rosapi or does not know the type.
        """
        args = {"type": self._session.core.wire.type_name(type)}
        return definitions_from_rosapi(await self._session.ask_rosapi("message_details", args, timeout))

    async def services(self, timeout: float = 1.0) -> list[str] | None:
        """Return the names of all services, or None if the server has no rosapi."""
        return await self._ask_names(timeout, "services")

    async def service_type(self, service: str, timeout: float = 1.0) -> str | None:
        """Return the type of a service, or None if the server has no rosapi.

        If the server does not know the service, the type is empty.
        """
        return await self._ask_type(timeout, "service_type", service=service)

    async def _ask_type(self, limit: float, question: str, **args: str) -> str | None:
        found = (await self._session.ask_rosapi(question, args, limit)).get("type")
        return found if isinstance(found, str) else None

    async def _ask_names(self, limit: float, question: str, **args: str) -> list[str] | None:
        """Return the names in the answer of the rosapi service `question`, or None if there is no answer."""
        names = (await self._session.ask_rosapi(question, args, limit)).get(question)
        return [name for name in names if isinstance(name, str)] if isinstance(names, list) else None


def connect(
    uri: str,
    *,
    connect_timeout: float = 10.0,
    retry: bool = False,
    ros_version: Literal["auto", "1", "2"] = "auto",
    token: str | None = None,
    headers: Mapping[str, str] | None = None,
    ca_file: Path | None = None,
    tls: SSLContext | None = None,
    max_size: int = MAX_SIZE,
    ping_interval: float = 5.0,
    ping_timeout: float = 5.0,
    check_types: bool = True,
    on_state: StateCallback | None = None,
) -> Ros:
    """Create a client of a rosbridge server. `async with` opens and closes the client.

    If the first connection fails, `async with` raises `UnreachableError` or `NotRosbridgeError`. If the connection is
    lost later, the client reconnects with a back-off from 0.1 s to 2 s. It then restores all advertisements,
    subscriptions and services.

    Args:
        uri: `ws://host:port`, `wss://host:port` for TLS, or `robot:NAME`. With TLS, the client always verifies the
            server's certificate. The name of a robot is looked up when the client is opened (`bridge.discovery`).
        connect_timeout: Timeout in seconds of the first connection, and of looking up a robot before it.
        retry: Whether to repeat the first attempt until `connect_timeout` is over if nothing answers at the URI. The
            client then calls `on_state` once, with `CONNECTING` and the reason.
        ros_version: ROS version of the type names that the client sends. `auto` uses names of ROS 1 until
            `Ros.detect_ros_version` has detected the version. ROS 2 servers accept names of ROS 1 too.
        token: Token of the header `Authorization: Bearer TOKEN`. The client never logs headers.
        headers: Additional headers of the handshake.
        ca_file: Certificate authorities (PEM) for the server, instead of the system's authorities.
        tls: An SSL context instead of `ca_file`, for example with a client certificate.
        max_size: Maximum size of a message in bytes, in both directions. If a larger message arrives, the connection
            ends, and the client does not subscribe to the message's topic again (`TopicLeftOutError`).
        ping_interval: Seconds of silence after which the server is pinged.
        ping_timeout: Seconds to wait for data after a ping before the connection counts as lost.
        check_types: Whether to check messages, requests and goals of known types before they are sent. The check
            refuses a misspelt field, and an array of another shape.
        on_state: Callback for each new state and its reason.

    Raises:
        UriError: The URI is not a WebSocket URI.
        OptionError: An option is out of its range, or a file cannot be read. For `robot:NAME`, errors in `token`,
            `headers`, `ca_file` and `tls` are raised when the client is opened.
    """
    if ros_version not in {"auto", "1", "2"}:
        raise OptionError(f"ros_version must be auto, 1 or 2, not {ros_version!r}")
    limits = Limits(
        connect_timeout=connect_timeout,
        max_size=max_size,
        ping_interval=ping_interval,
        ping_timeout=ping_timeout,
    )
    configured_version: RosVersion | None = None if ros_version == "auto" else 1 if ros_version == "1" else 2

    def server(uri: str) -> tuple[WebSocketURI, str, Route]:
        parsed = check_uri(uri)
        route = make_route(parsed, token=token, headers=headers, ca_file=ca_file, tls=tls)
        # The credentials are in the route, whose repr hides them.
        return replace(parsed, username=None, password=None), shown(uri), route

    # At once where that is possible, so that mistakes are found here and not when the client is opened.
    known = None if uri.startswith(ROBOT) else server(uri)

    async def locate() -> tuple[WebSocketURI, str, Route]:
        return known or server(await announced_uri(uri, connect_timeout))

    core = ClientCore(ros_version=configured_version, max_size=max_size)
    session = Session(shown(uri), locate, core, limits, on_state, retry=retry)
    return Ros(session, check_types=check_types)
