import json

import pytest

from tests.bridge.hub.broker_harness import WALL_CLOCK, Harness, Peer


@pytest.fixture
def hub() -> Harness:
    return Harness()


@pytest.fixture
def peer(hub: Harness) -> Peer:
    """The third client of a hub where the first two publish, hear and serve."""
    publisher, subscriber = hub.connect("10.0.0.1"), hub.connect("10.0.0.2")
    publisher.advertise("/boat/sensors", "boat_msgs/Sensors")
    publisher.advertise("/chatter", "std_msgs/msg/String")
    subscriber.subscribe("/chatter", type="std_msgs/String")
    subscriber.subscribe("/untyped")
    subscriber.send(op="advertise_service", service="/add", type="a/Add")
    return hub.connect()


def test_topics(peer: Peer) -> None:
    assert peer.rosapi("topics") == {
        "topics": ["/boat/sensors", "/chatter", "/untyped", "/rosout"],
        "types": ["boat_msgs/Sensors", "std_msgs/String", "", "rosgraph_msgs/Log"],
    }
    assert peer.rosapi("topic_type", topic="/chatter") == {"type": "std_msgs/String"}
    assert peer.rosapi("topic_type", topic="chatter") == {"type": "std_msgs/String"}
    assert peer.rosapi("topic_type", topic="/nowhere") == {"type": ""}
    assert peer.rosapi("topics_for_type", type="std_msgs/String") == {"topics": ["/chatter"]}
    assert peer.rosapi("topics_for_type", type="std_msgs/msg/String") == {"topics": ["/chatter"]}
    assert peer.rosapi("topics_for_type", type="a/B") == {"topics": []}
    assert peer.rosapi("topics_for_type", type="") == {"topics": []}


def test_nodes(peer: Peer) -> None:
    assert peer.rosapi("nodes") == {"nodes": ["/rosapi", "/client_1", "/client_2", "/client_3"]}
    assert peer.rosapi("publishers", topic="/chatter") == {"publishers": ["/client_1"]}
    assert peer.rosapi("subscribers", topic="/chatter") == {"subscribers": ["/client_2"]}
    assert peer.rosapi("publishers", topic="/nowhere") == {"publishers": []}
    assert peer.rosapi("node_details", node="/client_2") == {
        "publishing": [],
        "subscribing": ["/chatter", "/untyped"],
        "services": ["/add"],
    }
    assert peer.rosapi("node_details", node="client_1")["publishing"] == ["/boat/sensors", "/chatter"]
    assert "/rosapi/topics" in peer.rosapi("node_details", node="/rosapi")["services"]
    assert peer.rosapi("node_details", node="/nobody") == {
        "publishing": [],
        "subscribing": [],
        "services": [],
    }


def test_services(peer: Peer) -> None:
    services = peer.rosapi("services")["services"]
    assert {"/add", "/rosapi/topics", "/rosapi/get_param"} <= set(services)
    assert peer.rosapi("service_type", service="add") == {"type": "a/Add"}
    assert peer.rosapi("service_type", service="/rosapi/topics") == {"type": "rosapi/Topics"}
    assert peer.rosapi("service_type", service="/nowhere") == {"type": ""}
    assert peer.rosapi("services_for_type", type="a/srv/Add") == {"services": ["/add"]}
    assert peer.rosapi("services_for_type", type="rosapi/Topics") == {"services": ["/rosapi/topics"]}
    assert peer.rosapi("service_node", service="/add") == {"node": "/client_2"}
    assert peer.rosapi("service_node", service="/rosapi/topics") == {"node": "/rosapi"}
    assert peer.rosapi("service_node", service="/nowhere") == {"node": ""}
    assert peer.rosapi("service_host", service="/add") == {"host": "10.0.0.2"}
    assert peer.rosapi("service_host", service="/rosapi/topics") == {"host": "localhost"}
    assert peer.rosapi("service_host", service="/nowhere") == {"host": ""}
    assert peer.rosapi("service_providers", service="a/Add") == {"providers": ["/client_2"]}
    assert peer.rosapi("service_providers", service="rosapi/Topics") == {"providers": ["/rosapi"]}
    assert peer.rosapi("action_servers") == {"action_servers": []}


def test_every_service_that_is_listed_can_be_called(peer: Peer) -> None:
    for service in peer.rosapi("node_details", node="/rosapi")["services"]:
        answer = peer.ask(service)
        needs_more = service in {"/rosapi/set_param", "/rosapi/message_details"}  # a name, a type
        assert answer["result"] is not needs_more, answer


def test_unknown_definitions_are_refused(peer: Peer) -> None:
    answer = peer.ask("/rosapi/message_details", {"type": "boat_msgs/Sensors"})
    assert answer["result"] is False
    assert "boat_msgs/Sensors" in answer["values"]
    answer = peer.ask("/rosapi/service_request_details", {"type": "std_srvs/Empty"})
    assert (answer["result"], answer["values"]) == (
        False,
        "Service /rosapi/service_request_details does not exist",
    )


def test_time_has_the_fields_of_both_ros(peer: Peer) -> None:
    seconds, nanoseconds = divmod(WALL_CLOCK, 10**9)
    both = {"secs": seconds, "nsecs": nanoseconds, "sec": seconds, "nanosec": nanoseconds}
    assert peer.rosapi("get_time") == {"time": both}


def test_the_version_is_that_of_ros_1(peer: Peer) -> None:
    assert peer.rosapi("get_ros_version")["version"] == 1


def test_the_leading_slash_of_a_service_may_be_left_out(peer: Peer) -> None:
    answer = peer.ask("rosapi/topic_type", {"topic": "/chatter"}, id="x")
    assert answer["service"] == "rosapi/topic_type"
    assert answer["values"] == {"type": "std_msgs/String"}


def test_arguments_may_be_a_list_or_missing(peer: Peer) -> None:
    assert peer.ask("/rosapi/topic_type", ["/chatter"])["values"] == {"type": "std_msgs/String"}
    assert peer.ask("/rosapi/topic_type", ["/chatter", "too", "many"])["result"] is True
    assert peer.ask("/rosapi/topic_type", {})["values"] == {"type": ""}
    peer.send(op="call_service", service="/rosapi/topics", args=None)
    assert peer.read()[0]["result"] is True


@pytest.mark.parametrize("args", ["text", 7, {"topic": 7}, {"topic": None}, [["/chatter"]], True])
def test_wrong_arguments_fail_the_call(peer: Peer, args: object) -> None:
    answer = peer.ask("/rosapi/topic_type", args)
    assert answer["result"] is False
    assert "/rosapi/topic_type" in answer["values"]


# --- parameters


@pytest.mark.parametrize("value", [1, 2.5, "text", None, [1, 2], {"a": {"b": True}}])
def test_a_parameter_keeps_its_value(peer: Peer, value: object) -> None:
    assert peer.rosapi("has_param", name="/p") == {"exists": False}
    peer.rosapi("set_param", name="p", value=json.dumps(value))
    assert json.loads(peer.rosapi("get_param", name="/p")["value"]) == value
    assert peer.rosapi("has_param", name="p") == {"exists": True}
    assert peer.rosapi("get_param_names") == {"names": ["/p"]}
    peer.rosapi("delete_param", name="/p")
    assert peer.rosapi("has_param", name="/p") == {"exists": False}
    peer.rosapi("delete_param", name="/p")


def test_a_parameter_that_is_not_there_is_its_default_or_null(peer: Peer) -> None:
    assert peer.rosapi("get_param", name="/p") == {"value": "null"}
    assert peer.rosapi("get_param", name="/p", default="[1]") == {"value": "[1]"}


def test_parameters_outlive_their_client(hub: Harness, peer: Peer) -> None:
    peer.rosapi("set_param", name="/p", value="1")
    peer.disconnect()
    assert hub.connect().rosapi("get_param", name="/p") == {"value": "1"}


@pytest.mark.parametrize("value", ["", "text", "{", "NaN", "1e999", "[" * 100 + "]" * 100])
def test_a_parameter_must_be_json(peer: Peer, value: str) -> None:
    answer = peer.ask("/rosapi/set_param", {"name": "/p", "value": value})
    assert answer["result"] is False
    assert peer.rosapi("get_param_names") == {"names": []}


def test_parameters_are_bounded_in_number_and_size() -> None:
    peer = Harness(parameters=2, parameter_bytes=20).connect()

    def can_set(name: str, value: object) -> bool:
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
