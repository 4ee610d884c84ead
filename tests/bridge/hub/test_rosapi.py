import json

import pytest

from bridge.hub.rosapi import _ROS2_FIELDS, PREFIX
from tests.bridge.hub.broker_harness import WALL_CLOCK, Harness


@pytest.fixture
def peer(hub):
    """The third client of a hub where the first two publish, hear and serve."""
    publisher, subscriber = hub.connect("10.0.0.1"), hub.connect("10.0.0.2")
    publisher.advertise("/boat/sensors", "boat_msgs/Sensors")
    publisher.advertise("/chatter", "std_msgs/msg/String")
    subscriber.subscribe("/chatter", type="std_msgs/String")
    subscriber.subscribe("/untyped")
    subscriber.send(op="advertise_service", service="/add", type="a/Add")
    return hub.connect()


_NOTHING = {"publishing": [], "subscribing": [], "services": []}
_SECONDS, _NANOSECONDS = divmod(WALL_CLOCK, 10**9)
_TIME = dict.fromkeys(("secs", "sec"), _SECONDS) | dict.fromkeys(("nsecs", "nanosec"), _NANOSECONDS)


@pytest.mark.parametrize(
    ("service", "args", "values"),
    [
        ("topic_type", {"topic": "/chatter"}, {"type": "std_msgs/String"}),
        ("topic_type", {"topic": "/nowhere"}, {"type": ""}),
        ("topic_type", {}, {"type": ""}),
        ("topic_type", ["/chatter", "too", "many"], {"type": "std_msgs/String"}),
        ("topics_for_type", {"type": "std_msgs/String"}, {"topics": ["/chatter"]}),
        ("topics_for_type", {"type": "std_msgs/msg/String"}, {"topics": ["/chatter"]}),
        ("topics_for_type", {"type": ""}, {"topics": []}),
        ("nodes", None, {"nodes": ["/rosapi", "/client_1", "/client_2", "/client_3"]}),
        ("publishers", {"topic": "/chatter"}, {"publishers": ["/client_1"]}),
        ("subscribers", {"topic": "/chatter"}, {"subscribers": ["/client_2"]}),
        ("node_details", {"node": "client_1"}, _NOTHING | {"publishing": ["/boat/sensors", "/chatter"]}),
        (
            "node_details",
            {"node": "/client_2"},
            {"publishing": [], "subscribing": ["/chatter", "/untyped"], "services": ["/add"]},
        ),
        ("node_details", {"node": "/nobody"}, _NOTHING),
        ("service_type", {"service": "add"}, {"type": "a/Add"}),
        ("service_type", {"service": "/rosapi/topics"}, {"type": "rosapi/Topics"}),
        ("services_for_type", {"type": "a/srv/Add"}, {"services": ["/add"]}),
        ("services_for_type", {"type": "rosapi/Topics"}, {"services": ["/rosapi/topics"]}),
        ("service_node", {"service": "/add"}, {"node": "/client_2"}),
        ("service_node", {"service": "/rosapi/topics"}, {"node": "/rosapi"}),
        ("service_host", {"service": "/add"}, {"host": "10.0.0.2"}),
        ("service_host", {"service": "/rosapi/topics"}, {"host": "localhost"}),
        ("service_providers", {"service": "a/Add"}, {"providers": ["/client_2"]}),
        ("get_param", {"name": "/p"}, {"value": "null"}),
        ("get_param", {"name": "/p", "default": "[1]"}, {"value": "[1]"}),
        ("get_ros_version", {}, {"version": 1, "distro": "hub"}),
        ("get_time", {}, {"time": _TIME}),
        (
            "topics",
            {},
            {
                "topics": ["/boat/sensors", "/chatter", "/untyped", "/rosout"],
                "types": ["boat_msgs/Sensors", "std_msgs/String", "", "rosgraph_msgs/Log"],
            },
        ),
    ],
)
def test_the_graph_is_described(peer, service, args, values):
    for name in (f"/rosapi/{service}", f"rosapi/{service}"):
        answer = peer.ask(name, args)
        assert (answer["service"], answer["result"], answer["values"]) == (name, True, values)


def test_every_service_that_is_listed_can_be_called(peer):
    services = peer.rosapi("node_details", node="/rosapi")["services"]
    assert {"/add", "/rosapi/topics", "/rosapi/get_param", *services} == set(
        peer.rosapi("services")["services"]
    )
    for service in services:
        answer = peer.ask(service)
        needs_more = service == "/rosapi/set_param" or service.endswith("_details")  # a name, a type
        needs_more = needs_more and service != "/rosapi/node_details"
        assert answer["result"] is not needs_more, answer


@pytest.mark.parametrize(
    ("service", "type_name"),
    [("message_details", "boat_msgs/Sensors"), ("service_request_details", "boat_srvs/Row")],
)
def test_unknown_definitions_are_refused(peer, service, type_name):
    assert peer.ask(f"/rosapi/{service}", {"type": type_name})["result"] is False


@pytest.mark.parametrize(
    ("ros_version", "service", "types"),
    [
        (1, "std_srvs/SetBool", ("SetBoolRequest", "SetBoolResponse")),
        (2, "std_srvs/srv/SetBool", ("SetBool_Request", "SetBool_Response")),
        (1, "actionlib_tutorials/Fibonacci", ("FibonacciGoal", "FibonacciResult", "FibonacciFeedback")),
        (
            2,
            "example_interfaces/action/Fibonacci",
            ("Fibonacci_Goal", "Fibonacci_Result", "Fibonacci_Feedback"),
        ),
    ],
)
def test_details_of_services_and_actions(ros_version, service, types):
    peer = Harness(ros_version=ros_version).connect()
    fields = {"Request": ["data"], "Response": ["success", "message"], "Goal": ["order"]}
    for name in types:
        part = name.removeprefix(service.split("/")[-1]).removeprefix("_")
        kind = "service" if part in {"Request", "Response"} else "action"
        (found,) = peer.rosapi(f"{kind}_{part.lower()}_details", type=service)["typedefs"]
        assert found["type"] == f"{service.rpartition('/')[0]}/{name}"
        assert found["fieldnames"] == fields.get(part, ["sequence"])
        assert found["fieldarraylen"] == ([0] if part in {"Result", "Feedback"} else [-1] * len(fields[part]))
    (empty,) = peer.rosapi("service_request_details", type="std_srvs/Empty")["typedefs"]
    assert empty["fieldnames"] == []


@pytest.mark.parametrize("ros_version", [1, 2])
def test_services_of_rosapi_are_defined(ros_version):
    peer = Harness(ros_version=ros_version).connect()
    for service in peer.rosapi("services")["services"]:
        type_name = peer.rosapi("service_type", service=service)["type"]
        (request,) = peer.rosapi("service_request_details", type=type_name)["typedefs"]
        names = [
            _ROS2_FIELDS.get(name, name) if ros_version == 2 else name for name in _arguments(peer, service)
        ]
        assert request["fieldnames"] == names
        peer.rosapi("service_response_details", type=type_name)


def _arguments(peer, service):
    _type, names, _answer = peer.hub.broker._calls._rosapi._services[service.removeprefix(PREFIX)]
    return names


def test_a_default_of_a_parameter_under_both_of_its_names():
    peer = Harness(ros_version=2).connect()
    for name in ("default", "default_value"):
        assert peer.rosapi("get_param", name="/p", **{name: "7"})["value"] == "7"


@pytest.mark.parametrize("args", ["text", 7, {"topic": 7}, {"topic": None}, [["/chatter"]], True])
def test_wrong_arguments_fail_the_call(peer, args):
    assert peer.ask("/rosapi/topic_type", args)["result"] is False


# --- parameters


@pytest.mark.parametrize("value", [1, 2.5, "text", None, [1, 2], {"a": {"b": True}}])
def test_a_parameter_keeps_its_value_and_outlives_its_client(hub, peer, value):
    assert peer.rosapi("has_param", name="/p") == {"exists": False}
    peer.rosapi("set_param", name="p", value=json.dumps(value))
    peer.disconnect()
    other = hub.connect()
    assert json.loads(other.rosapi("get_param", name="/p")["value"]) == value
    assert other.rosapi("has_param", name="p") == {"exists": True}
    assert other.rosapi("get_param_names") == {"names": ["/p"]}
    for _ in range(2):
        other.rosapi("delete_param", name="/p")
        assert other.rosapi("has_param", name="/p") == {"exists": False}


@pytest.mark.parametrize("value", ["", "text", "{", "NaN", "1e999", "[" * 100 + "]" * 100])
def test_a_parameter_must_be_json(peer, value):
    answer = peer.ask("/rosapi/set_param", {"name": "/p", "value": value})
    assert answer["result"] is False
    assert peer.rosapi("get_param_names") == {"names": []}


def test_parameters_are_bounded_in_number_and_size():
    peer = Harness(parameters=2, parameter_bytes=20).connect()

    def can_set(name, value):
        return bool(peer.ask("/rosapi/set_param", {"name": name, "value": json.dumps(value)})["result"])

    assert can_set("/a", "x" * 8)
    assert not can_set("/b", "x" * 9)
    assert can_set("/b", "x" * 8)
    assert not can_set("/c", 1)
    assert not can_set("/a", "x" * 9)
    peer.rosapi("delete_param", name="/b")
    assert can_set("/a", "x" * 18)
    assert not can_set("/" + "n" * 255, 1)
    assert not can_set("", 1)
