"""Questions to rosapi: the parameters, topics, services and nodes of a ROS system."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import orjson

from bridge.client.session import Session
from bridge.codecs.json_codec import encode
from bridge.codecs.message_check import Definitions, definitions_from_rosapi
from bridge.errors import ParamError

_REQUIRED: Final[Any] = object()


@dataclass(frozen=True, slots=True)
class NodeDetails:
    """The topics and services of a node, by name."""

    subscribing: list[str]
    publishing: list[str]
    services: list[str]


async def ask_text(
    session: Session, question: str, args: Mapping[str, Any], field: str, limit: float
) -> str | None:
    """Return a text from an answer of rosapi; None without rosapi."""
    value = (await session.ask_rosapi(question, args, limit)).get(field)
    return value if isinstance(value, str) else None


async def ask_names(
    session: Session, question: str, args: Mapping[str, Any], field: str, limit: float
) -> list[str] | None:
    """Return a list of names from an answer of rosapi; None without rosapi."""
    names = (await session.ask_rosapi(question, args, limit)).get(field)
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else None


async def ask_node(session: Session, node: str, limit: float) -> NodeDetails | None:
    """Return the topics and services of a node; None without rosapi."""
    answer = await session.ask_rosapi("node_details", {"node": node}, limit)
    fields = [answer.get(name) for name in ("subscribing", "publishing", "services")]
    if not all(isinstance(names, list) for names in fields):
        return None
    return NodeDetails(*([name for name in names or [] if isinstance(name, str)] for names in fields))


async def ask_definitions(session: Session, type_name: str, limit: float) -> Definitions:
    """Return the fields of a message type and of its parts; empty if rosapi does not know it."""
    args = {"type": session.core.wire.type_name(type_name)}
    return definitions_from_rosapi(await session.ask_rosapi("message_details", args, limit))


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
