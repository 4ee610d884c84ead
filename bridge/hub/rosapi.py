"""The services of ROS's `rosapi` node, which the hub answers from its own state.

Clients call the services for diagnosis, parameters and the fields of messages. Names, fields and types are those of the
emulated ROS version (http://wiki.ros.org/rosapi, rosapi_msgs). A service that exists in only one version is answered in
both. A time has the fields of both versions: `secs` and `nsecs`, `sec` and `nanosec`.

Parameters are a flat dictionary from names to JSON. If an access to a parameter fails, a hub of ROS 2 answers with
`successful` and `reason`. In ROS 1, the call fails.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final

import orjson

from bridge.codecs.json_codec import is_deeper
from bridge.errors import NameFormError
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.graph import Graph
from bridge.hub.interfaces import PARTS, part_name
from bridge.hub.limits import HubLimits, RefusedOperationError
from bridge.names import MAX_NAME, absolute, ros1_type, ros2_type

NODE: Final = "/rosapi"
"""Name of the node that offers rosapi's services."""
PREFIX: Final = NODE + "/"
"""Prefix of the names of rosapi's services. Clients cannot offer services with this prefix."""
ROSOUT: Final = "/rosout"
"""The topic of ROS's log, on which the hub reports refused operations."""
# Topics that a server of ROS 1's actionlib publishes or subscribes to under its name.
_ACTIONLIB: Final = ("goal", "cancel", "status", "feedback", "result")

# Fields that have another name in ROS 2.
_ROS2_FIELDS: Final = {"default": "default_value"}

Values = dict[str, Any]
_Answer = Callable[..., Values]


def rosout_type(ros_version: int) -> str:
    """Return the type of `ROSOUT`."""
    return "rcl_interfaces/msg/Log" if ros_version == 2 else "rosgraph_msgs/Log"


class Rosapi:
    """The rosapi services of one hub."""

    def __init__(
        self, graph: Graph, limits: HubLimits, definitions: MessageDefinitions, wall_clock: Callable[[], int]
    ) -> None:
        """Serve the state in `graph`. `wall_clock` returns the time in nanoseconds since 1970."""
        self._graph = graph
        self._limits = limits
        self._definitions = definitions
        self._wall_clock = wall_clock
        self.ros_version = definitions.ros_version
        self._parameters: dict[str, bytes] = {}
        self._parameter_bytes = 0
        # short name -> type, arguments (all strings) in order, function
        self._services: dict[str, tuple[str, tuple[str, ...], _Answer]] = {
            "action_servers": ("GetActionServers", (), self._action_servers),
            "action_type": ("ActionType", ("action",), self._action_type),
            "delete_param": ("DeleteParam", ("name",), self._delete_param),
            "get_param": ("GetParam", ("name", "default"), self._get_param),
            "get_param_names": ("GetParamNames", (), self._get_param_names),
            "get_ros_version": ("GetROSVersion", (), self._get_ros_version),
            "get_time": ("GetTime", (), self._get_time),
            "has_param": ("HasParam", ("name",), self._has_param),
            "interfaces": ("Interfaces", (), self._interfaces),
            "message_details": ("MessageDetails", ("type",), self._message_details),
            "node_details": ("NodeDetails", ("node",), self._node_details),
            "nodes": ("Nodes", (), self._nodes),
            "search_param": ("SearchParam", ("name",), self._search_param),
            "publishers": ("Publishers", ("topic",), self._publishers),
            "service_host": ("ServiceHost", ("service",), self._service_host),
            "service_node": ("ServiceNode", ("service",), self._service_node),
            "service_providers": ("ServiceProviders", ("service",), self._service_providers),
            "service_type": ("ServiceType", ("service",), self._service_type),
            "services": ("Services", (), self._all_services),
            "services_for_type": ("ServicesForType", ("type",), self._services_for_type),
            "set_param": ("SetParam", ("name", "value"), self._set_param),
            "subscribers": ("Subscribers", ("topic",), self._subscribers),
            "topic_type": ("TopicType", ("topic",), self._topic_type),
            "topics": ("Topics", (), self._topics),
            "topics_and_raw_types": ("TopicsAndRawTypes", (), self._topics_and_raw_types),
            "topics_for_type": ("TopicsForType", ("type",), self._topics_for_type),
        }
        for kind, parts in ("action", PARTS["action"]), ("service", PARTS["srv"]):
            for part in parts:
                details = f"{kind.title()}{part}Details", ("type",), partial(self._part_details, part)
                self._services[f"{kind}_{part.lower()}_details"] = details

    def offers(self, service: str) -> bool:
        """Return whether the hub itself offers the service with this absolute name."""
        return service.startswith(PREFIX) and service.removeprefix(PREFIX) in self._services

    def call(self, service: str, args: object) -> Values:
        """Answer a call of a service for which `offers` has returned true. Return the `values` of the answer.

        `args` is an object, or a list in the order of the service's fields. An omitted field counts as an empty
        string, as in ROS.

        Raises:
            RefusedOperationError: The arguments are wrong, or a limit is reached.
        """
        _type, names, answer = self._services[service.removeprefix(PREFIX)]
        if isinstance(args, list):
            args = dict(zip(names, args, strict=False))
        if not isinstance(args, dict):
            raise RefusedOperationError(
                f"{service}: args must be an object with the fields {', '.join(names) or '(none)'}"
            )
        given = [args.get(name, args.get(_ROS2_FIELDS.get(name), "")) for name in names]
        for name, value in zip(names, given, strict=True):
            if not isinstance(value, str):
                raise RefusedOperationError(f"{service}: field {name} must be a string")
        return answer(*given)

    def service_type_name(self, type_name: str) -> str:
        """Return the name of a service type in the form of the emulated ROS version."""
        return ros2_type(type_name, "srv") if self.ros_version == 2 else ros1_type(type_name)

    # --- topics

    def _all_topics(self) -> dict[str, str]:
        """Return the types of all topics, including the hub's own."""
        topics = {topic.name: topic.type for topic in self._graph.topics.values()}
        return topics | {ROSOUT: rosout_type(self.ros_version)}

    def _topics(self) -> Values:
        topics = self._all_topics()
        return {"topics": list(topics), "types": list(topics.values())}

    def _topics_and_raw_types(self) -> Values:
        topics = self._all_topics()
        texts = {type_name: self._full_text(type_name) for type_name in set(topics.values())}
        if sum(len(texts[type_name]) for type_name in topics.values()) > self._limits.message_bytes:
            raise RefusedOperationError(f"the definitions have more than {self._limits.message_bytes} bytes")
        return {
            "topics": list(topics),
            "types": list(topics.values()),
            "typedefs_full_text": [texts[type_name] for type_name in topics.values()],
        }

    def _full_text(self, type_name: str) -> str:
        try:
            return self._definitions.full_text(type_name) if type_name else ""
        except RefusedOperationError:
            return ""

    def _topics_for_type(self, type_name: str) -> Values:
        return {"topics": _of_type(self._all_topics().items(), type_name, self._definitions.name)}

    def _topic_type(self, name: str) -> Values:
        return {"type": self._all_topics().get(absolute(name), "")}

    def _publishers(self, name: str) -> Values:
        topic = self._graph.topics.get(absolute(name))
        # The hub publishes its refusals there, without being a client.
        own = [NODE] if absolute(name) == ROSOUT else []
        return {"publishers": own + ([client.node for client in topic.advertisements] if topic else [])}

    def _interfaces(self) -> Values:
        types = {*self._all_topics().values(), *self._own_types().values()}
        types |= {service.type for service in self._graph.services.values()}
        types |= {action.type for action in self._graph.actions.values()}
        return {"interfaces": sorted(types - {""})}

    def _message_details(self, type_name: str) -> Values:
        return {"typedefs": self._definitions.details(type_name)}

    def _part_details(self, part: str, type_name: str) -> Values:
        return self._message_details(part_name(type_name, part, self.ros_version))

    def _subscribers(self, name: str) -> Values:
        topic = self._graph.topics.get(absolute(name))
        return {"subscribers": [client.node for client in topic.subscriptions] if topic else []}

    # --- services

    def _own_types(self) -> dict[str, str]:
        package = "rosapi_msgs/srv" if self.ros_version == 2 else "rosapi"
        return {PREFIX + name: f"{package}/{entry[0]}" for name, entry in self._services.items()}

    def _all_services(self) -> Values:
        return {"services": [*self._own_types(), *self._graph.services]}

    def _service_type(self, name: str) -> Values:
        name = absolute(name)
        service = self._graph.services.get(name)
        return {"type": service.type if service else self._own_types().get(name, "")}

    def _services_for_type(self, type_name: str) -> Values:
        services = {name: service.type for name, service in self._graph.services.items()}
        return {
            "services": _of_type((self._own_types() | services).items(), type_name, self.service_type_name)
        }

    def _server(self, name: str) -> tuple[str, str]:
        """Return the node that serves a service, and the host of that node, or two empty strings."""
        service = self._graph.services.get(absolute(name))
        if service:
            return service.client.node, service.client.address
        return (NODE, "localhost") if self.offers(absolute(name)) else ("", "")

    def _service_node(self, name: str) -> Values:
        return {"node": self._server(name)[0]}

    def _service_host(self, name: str) -> Values:
        return {"host": self._server(name)[1]}

    def _service_providers(self, type_name: str) -> Values:
        nodes = [self._server(name)[0] for name in self._services_for_type(type_name)["services"]]
        return {"providers": list(dict.fromkeys(nodes))}

    def _action_servers(self) -> Values:
        topics = self._graph.topics
        names = [name.removesuffix("/goal") for name in topics if name.endswith("/goal")]
        theirs = [name for name in names if all(f"{name}/{part}" in topics for part in _ACTIONLIB)]
        return {"action_servers": [*self._graph.actions, *theirs]}

    def _action_type(self, name: str) -> Values:
        action = self._graph.actions.get(absolute(name))
        return {"type": action.type if action else ""}

    # --- nodes, time, version

    def _nodes(self) -> Values:
        return {"nodes": [NODE, *(client.node for client in self._graph.clients.values())]}

    def _node_details(self, node: str) -> Values:
        node = absolute(node)
        if node == NODE:
            return {"subscribing": [], "publishing": [ROSOUT], "services": list(self._own_types())}
        client = next((each for each in self._graph.clients.values() if each.node == node), None)
        if client is None:
            return {"subscribing": [], "publishing": [], "services": []}
        return {
            "subscribing": list(client.subscriptions),
            "publishing": list(client.advertisements),
            "services": sorted(client.services),
        }

    def _get_time(self) -> Values:
        seconds, nanoseconds = divmod(self._wall_clock(), 10**9)
        return {"time": {"secs": seconds, "nsecs": nanoseconds, "sec": seconds, "nanosec": nanoseconds}}

    def _get_ros_version(self) -> Values:
        return {"version": self.ros_version, "distro": "hub"}

    # --- parameters

    def _outcome(self, failure: str = "", **values: Any) -> Values:
        """Return the answer of a service about parameters, or its failure, in this ROS version's form."""
        if self.ros_version == 2:
            return values | {"successful": not failure, "reason": failure}
        if failure:
            raise RefusedOperationError(failure)
        return values

    def _get_param(self, name: str, default: str) -> Values:
        value = self._parameters.get(absolute(name))
        if value is not None:
            return self._outcome(value=value.decode())
        if self.ros_version == 2 and not default:
            return self._outcome(f"there is no parameter {name}", value="null")
        return self._outcome(value=default or "null")

    def _has_param(self, name: str) -> Values:
        return {"exists": absolute(name) in self._parameters}

    def _search_param(self, name: str) -> Values:
        key = absolute(name)
        # As on the reference server for a name of a namespace, which has a parameter below it.
        below = any(each == key or each.startswith(key + "/") for each in self._parameters)
        return {"global_name": key if below else ""}

    def _get_param_names(self) -> Values:
        return {"names": list(self._parameters)}

    def _set_param(self, name: str, value: str) -> Values:
        if not name or len(name) > MAX_NAME:
            return self._outcome(f"the name of a parameter has 1 to {MAX_NAME} characters")
        try:
            parsed = orjson.loads(value)
        except orjson.JSONDecodeError:
            return self._outcome(f"the value of parameter {name} must be JSON text")
        if is_deeper(value.encode(), self._limits.depth):
            return self._outcome(
                f"the value of parameter {name} is nested deeper than {self._limits.depth} levels"
            )
        data = orjson.dumps(parsed)
        key = absolute(name)
        size = self._parameter_bytes + len(data) - len(self._parameters.get(key, b""))
        if size > self._limits.parameter_bytes:
            return self._outcome(f"all parameters together may have {self._limits.parameter_bytes} bytes")
        if key not in self._parameters and len(self._parameters) >= self._limits.parameters:
            return self._outcome(f"there are already {self._limits.parameters} parameters")
        self._parameters[key] = data
        self._parameter_bytes = size
        return self._outcome()

    def _delete_param(self, name: str) -> Values:
        self._parameter_bytes -= len(self._parameters.pop(absolute(name), b""))
        return self._outcome()


def _of_type(types: Iterable[tuple[str, str]], type_name: str, normalise: Callable[[str], str]) -> list[str]:
    """Return the names from (name, type) pairs with this type, which is given in the form of ROS 1 or ROS 2."""
    try:
        wanted = normalise(type_name)
    except NameFormError:
        return []
    return [name for name, its_type in types if its_type == wanted]
