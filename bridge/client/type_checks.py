"""Checks of the data that a client sends. A check compares data with the definition of the data's ROS type.

rosapi, a node beside most rosbridge servers, sends the definitions. Its services have names below `/rosapi`.
"""

import asyncio
import logging
from collections.abc import Mapping
from typing import Any, Final, Literal

from bridge.client.session import Session
from bridge.codecs.message_check import (
    Definitions,
    MessageCheck,
    bundled_definitions,
    check_from_rosapi,
    definitions_from_rosapi,
)
from bridge.errors import BridgeError, MessageTypeError, NoAnswerError, ServiceError
from bridge.names import absolute, ros2_type

_ROSAPI_TIMEOUT: Final = 1.0
_ROSAPI: Final = "/rosapi/"
_MAX_SERVICES: Final = 1000
"""Maximum number of services for which a client remembers the type. For other services, each call asks for the type."""

_log = logging.getLogger("bridge")

_Part = Literal["service_request", "service_response", "action_goal", "action_result", "action_feedback"]


class TypeChecks:
    """The type checks of one client's data. If rosapi does not answer, it is not asked again on this connection."""

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
        """Get the definition of an unknown message type from rosapi or rosbags, to check later messages of the type."""
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
        """Check a request for a service against the service's type.

        The client asks rosapi for an unknown type, and waits at most `limit` seconds for each answer.

        Raises:
            MessageTypeError: The request has a field that the type does not have, or an array of another shape.
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
        """Check a goal of an action of ROS 2. `limit` and the errors are as in `check_request`."""
        if self._may_ask():
            check = await self.part("action_goal", ros2_type(type_name, "action"), limit)
            _apply(check, goal, f"a goal of {action}")

    async def part(self, part: _Part, type_name: str, limit: float = _ROSAPI_TIMEOUT) -> MessageCheck | None:
        """Return the check of a request, answer, goal, result or feedback, or None if the type is unknown."""
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
