"""Questions to rosapi: parameters, topics, services, nodes, and the definitions of types to check messages with.

rosapi is a node that runs beside most rosbridge servers, and answers service calls below `/rosapi`.
"""

import asyncio
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import orjson

from bridge.client.session import Session
from bridge.codecs.json_codec import encode
from bridge.codecs.message_check import (
    Definitions,
    MessageCheck,
    bundled_definitions,
    check_from_rosapi,
    definitions_from_rosapi,
)
from bridge.errors import BridgeError, MessageTypeError, NoAnswerError, ParamError, ServiceError
from bridge.names import absolute, ros2_type

_REQUIRED: Final[Any] = object()
_ROSAPI_TIMEOUT: Final = 1.0
_ROSAPI: Final = "/rosapi/"
_MAX_SERVICES: Final = 1000
"""Maximum number of services whose types are remembered; those of others are asked for again."""

_log = logging.getLogger("bridge")

_Part = Literal["service_request", "service_response", "action_goal", "action_result", "action_feedback"]


@dataclass(frozen=True, slots=True)
class NodeDetails:
    """The topics and services of a node, by name."""

    subscribing: list[str]
    publishing: list[str]
    services: list[str]


class Params:
    """The parameters of a ROS system. In ROS 2 a parameter belongs to a node, and its name is `/node:param`.

    Values are those of JSON: numbers, strings, booleans, lists, and in ROS 1 dictionaries.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    async def get(self, name: str, default: Any = _REQUIRED, *, timeout: float = 5.0) -> Any:
        """Return the value of a parameter, or `default` if it does not exist.

        Raises:
            ParamError: It does not exist, and there is no default.
            ServiceError: rosapi refused the call, or does not exist.
            NoAnswerError: rosapi did not answer in time.
            DisconnectedError: There is no connection.
        """
        answer = await self._ask("get_param", timeout, name=name)
        # The value is JSON in a string, because a ROS service cannot have a field of any type.
        text = answer.get("value")
        try:
            value = orjson.loads(text) if isinstance(text, str) and text else None
        except orjson.JSONDecodeError:
            value = text  # ROS 2 writes some values as plain text
        if value is not None:
            return value
        if default is not _REQUIRED:
            return default
        raise ParamError(self._sentence(name, answer, "it does not exist"))

    async def set(self, name: str, value: Any, *, timeout: float = 5.0) -> None:
        """Set a parameter; errors as for `get`, and `ParamError` if the server refuses."""
        # The codec encodes only objects, so the value is wrapped in one and cut out again.
        text = encode({"": value}, nonfinite="refuse")[4:-1].decode()
        self._require(name, await self._ask("set_param", timeout, name=name, value=text))

    async def has(self, name: str, *, timeout: float = 5.0) -> bool:
        """Return whether a parameter exists; errors as for `get`."""
        return (await self._ask("has_param", timeout, name=name)).get("exists") is True

    async def delete(self, name: str, *, timeout: float = 5.0) -> None:
        """Delete a parameter; errors as for `set`."""
        self._require(name, await self._ask("delete_param", timeout, name=name))

    async def names(self, *, timeout: float = 5.0) -> list[str]:
        """Return the names of all parameters; errors as for `get`."""
        names = (await self._ask("get_param_names", timeout)).get("names")
        return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []

    async def _ask(self, question: str, limit: float, **args: str) -> dict[str, Any]:
        answer = await self._session.call(f"/rosapi/{question}", args, limit)
        return answer if isinstance(answer, dict) else {}

    def _require(self, name: str, answer: dict[str, Any]) -> None:
        if answer.get("successful") is False:  # ROS 2; ROS 1 refuses the call
            raise ParamError(self._sentence(name, answer, "the server refused"))

    def _sentence(self, name: str, answer: dict[str, Any], otherwise: str) -> str:
        reason = answer.get("reason")
        why = reason[:200] if isinstance(reason, str) and reason else otherwise
        form = (
            "; in ROS 2 its name is /node:param"
            if ":" not in name and self._session.core.ros_version == 2
            else ""
        )
        return f"parameter {name} at {self._session.uri}: {why}{form}"


class TypeChecks:
    """The checks of what one client sends. A server that does not answer is not asked again on the same connection."""

    def __init__(self, session: Session) -> None:
        self._session = session
        # Held during a question, so that simultaneous calls of one service ask only once.
        self._asking = asyncio.Lock()
        # Number of reconnections when the following was learnt: another connection may be to another server.
        self._connection = -1
        # Whether a question went unanswered: a server without rosapi must not delay each call by a timeout.
        self._unanswered = False
        # Names of types by service, and checks by part and type; None for a type that the server does not know. Both
        # are bounded, because a program may call any number of services.
        self._service_types: dict[str, str] = {}
        self._parts: dict[tuple[_Part, str], MessageCheck | None] = {}

    async def learn_message(self, type_name: str) -> None:
        """Ask for the definition of a message type, unless it is known, to check messages before they are sent."""
        session = self._session
        publications = session.core.publications
        if publications.is_known(type_name) or not session.is_open:
            return
        definitions: Definitions = {}
        if self._may_ask():
            args = {"type": session.core.wire.type_name(type_name)}
            definitions = definitions_from_rosapi(await self._ask("message_details", args, _ROSAPI_TIMEOUT))
        version = session.core.ros_version
        # In a thread, because loading rosbags would block the event loop for too long.
        if not definitions and version is not None:
            definitions = await asyncio.to_thread(bundled_definitions, type_name, version)
        publications.define(type_name, definitions)

    async def check_request(self, service: str, args: Mapping[str, Any], limit: float) -> None:
        """Check a request for a service; each question to rosapi about its type takes at most `limit` seconds.

        Raises:
            MessageTypeError: It has a field that the type does not have, or an array of another shape.
        """
        # Requests to rosapi itself are made by this client, and asking about them would never end.
        name = absolute(service)
        if name.startswith(_ROSAPI) or not self._may_ask():
            return
        limit = min(limit, _ROSAPI_TIMEOUT)
        async with self._asking:
            type_name = self._service_types.get(name)
            if type_name is None and self._may_ask():
                found = (await self._ask("service_type", {"service": name}, limit)).get("type")
                type_name = found if isinstance(found, str) else ""
                if type_name and len(self._service_types) < _MAX_SERVICES:
                    self._service_types[name] = type_name
        check = await self.part("service_request", type_name, limit) if type_name else None
        _apply(check, args, f"a call of {service}")

    async def check_goal(self, action: str, type_name: str, goal: Mapping[str, Any], limit: float) -> None:
        """Check a goal of an action of ROS 2; limit and errors as for `check_request`."""
        if self._may_ask():
            check = await self.part("action_goal", ros2_type(type_name, "action"), limit)
            _apply(check, goal, f"a goal of {action}")

    async def part(self, part: _Part, type_name: str, limit: float = _ROSAPI_TIMEOUT) -> MessageCheck | None:
        """Return the check of a part of a service or of an action; None if the server does not know the type."""
        async with self._asking:
            key = part, type_name
            if key not in self._parts and self._may_ask():
                answer = await self._ask(f"{part}_details", {"type": type_name}, min(limit, _ROSAPI_TIMEOUT))
                if len(self._parts) < _MAX_SERVICES:
                    self._parts[key] = check_from_rosapi(answer)
            return self._parts.get(key)

    def _may_ask(self) -> bool:
        session = self._session
        if self._connection != session.reconnections:
            self._connection = session.reconnections
            self._unanswered = False
            self._service_types.clear()
            self._parts.clear()
        return session.is_open and not self._unanswered

    async def _ask(self, question: str, args: Mapping[str, Any], limit: float) -> dict[str, Any]:
        # Whatever fails here, the program's own message, call or goal is then sent unchecked.
        try:
            answer = await self._session.call(_ROSAPI + question, args, limit)
        except NoAnswerError:
            self._unanswered = True
        except ServiceError as error:
            self._unanswered = question == "service_type"  # which refuses no service: there is no rosapi
            _log.debug("the type of %s is unknown: %s", args, error)
        except BridgeError as error:
            _log.debug("the type of %s is unknown: %s", args, error)
        else:
            return answer if isinstance(answer, dict) else {}
        return {}


def _apply(check: MessageCheck | None, values: Mapping[str, Any], what: str) -> None:
    try:
        if check is not None:
            check(values)
    except MessageTypeError as error:
        raise MessageTypeError(f"{what} cannot be sent: {error}") from None
