import json

import pytest

from tests.bridge.hub.broker_harness import WALL_CLOCK, Guest, Room


@pytest.fixture
def room() -> Room:
    return Room()


@pytest.fixture
def guest(room: Room) -> Guest:
    """The third client of a hub where the first two publish, hear and serve."""
    publisher, subscriber = room.enter("10.0.0.1"), room.enter("10.0.0.2")
    publisher.advertise("/boat/sensors", "boat_msgs/Sensors")
    publisher.advertise("/chatter", "std_msgs/msg/String")
    subscriber.subscribe("/chatter", type="std_msgs/String")
    subscriber.subscribe("/untyped")
    subscriber.send(op="advertise_service", service="/add", type="a/Add")
    return room.enter()


def test_topics(guest: Guest) -> None:
    assert guest.rosapi("topics") == {
        "topics": ["/boat/sensors", "/chatter", "/untyped", "/rosout"],
        "types": ["boat_msgs/Sensors", "std_msgs/String", "", "rosgraph_msgs/Log"],
    }
    assert guest.rosapi("topic_type", topic="/chatter") == {"type": "std_msgs/String"}
    assert guest.rosapi("topic_type", topic="chatter") == {"type": "std_msgs/String"}
    assert guest.rosapi("topic_type", topic="/nowhere") == {"type": ""}
    assert guest.rosapi("topics_for_type", type="std_msgs/String") == {"topics": ["/chatter"]}
    assert guest.rosapi("topics_for_type", type="std_msgs/msg/String") == {"topics": ["/chatter"]}
    assert guest.rosapi("topics_for_type", type="a/B") == {"topics": []}
    assert guest.rosapi("topics_for_type", type="") == {"topics": []}


def test_nodes(guest: Guest) -> None:
    assert guest.rosapi("nodes") == {"nodes": ["/rosapi", "/client_1", "/client_2", "/client_3"]}
    assert guest.rosapi("publishers", topic="/chatter") == {"publishers": ["/client_1"]}
    assert guest.rosapi("subscribers", topic="/chatter") == {"subscribers": ["/client_2"]}
    assert guest.rosapi("publishers", topic="/nowhere") == {"publishers": []}
    assert guest.rosapi("node_details", node="/client_2") == {
        "publishing": [],
        "subscribing": ["/chatter", "/untyped"],
        "services": ["/add"],
    }
    assert guest.rosapi("node_details", node="client_1")["publishing"] == ["/boat/sensors", "/chatter"]
    assert "/rosapi/topics" in guest.rosapi("node_details", node="/rosapi")["services"]
    assert guest.rosapi("node_details", node="/nobody") == {
        "publishing": [],
        "subscribing": [],
        "services": [],
    }


def test_services(guest: Guest) -> None:
    services = guest.rosapi("services")["services"]
    assert {"/add", "/rosapi/topics", "/rosapi/get_param"} <= set(services)
    assert guest.rosapi("service_type", service="add") == {"type": "a/Add"}
    assert guest.rosapi("service_type", service="/rosapi/topics") == {"type": "rosapi/Topics"}
    assert guest.rosapi("service_type", service="/nowhere") == {"type": ""}
    assert guest.rosapi("services_for_type", type="a/srv/Add") == {"services": ["/add"]}
    assert guest.rosapi("services_for_type", type="rosapi/Topics") == {"services": ["/rosapi/topics"]}
    assert guest.rosapi("service_node", service="/add") == {"node": "/client_2"}
    assert guest.rosapi("service_node", service="/rosapi/topics") == {"node": "/rosapi"}
    assert guest.rosapi("service_node", service="/nowhere") == {"node": ""}
    assert guest.rosapi("service_host", service="/add") == {"host": "10.0.0.2"}
    assert guest.rosapi("service_host", service="/rosapi/topics") == {"host": "localhost"}
    assert guest.rosapi("service_host", service="/nowhere") == {"host": ""}
    assert guest.rosapi("service_providers", service="a/Add") == {"providers": ["/client_2"]}
    assert guest.rosapi("service_providers", service="rosapi/Topics") == {"providers": ["/rosapi"]}
    assert guest.rosapi("action_servers") == {"action_servers": []}


def test_every_service_that_is_listed_can_be_called(guest: Guest) -> None:
    for service in guest.rosapi("node_details", node="/rosapi")["services"]:
        answer = guest.ask(service)
        needs_more = service in {"/rosapi/set_param", "/rosapi/message_details"}  # a name, a type
        assert answer["result"] is not needs_more, answer


def test_what_the_hub_cannot_know_is_said(guest: Guest) -> None:
    answer = guest.ask("/rosapi/message_details", {"type": "boat_msgs/Sensors"})
    assert answer["result"] is False
    assert "boat_msgs/Sensors" in answer["values"]
    answer = guest.ask("/rosapi/service_request_details", {"type": "std_srvs/Empty"})
    assert (answer["result"], answer["values"]) == (
        False,
        "Service /rosapi/service_request_details does not exist",
    )


def test_time_has_the_fields_of_both_ros(guest: Guest) -> None:
    seconds, nanoseconds = divmod(WALL_CLOCK, 10**9)
    both = {"secs": seconds, "nsecs": nanoseconds, "sec": seconds, "nanosec": nanoseconds}
    assert guest.rosapi("get_time") == {"time": both}


def test_the_version_is_that_of_ros_1(guest: Guest) -> None:
    assert guest.rosapi("get_ros_version")["version"] == 1


def test_the_leading_slash_of_a_service_may_be_left_out(guest: Guest) -> None:
    answer = guest.ask("rosapi/topic_type", {"topic": "/chatter"}, id="x")
    assert answer["service"] == "rosapi/topic_type"
    assert answer["values"] == {"type": "std_msgs/String"}


def test_arguments_may_be_a_list_or_missing(guest: Guest) -> None:
    assert guest.ask("/rosapi/topic_type", ["/chatter"])["values"] == {"type": "std_msgs/String"}
    assert guest.ask("/rosapi/topic_type", ["/chatter", "too", "many"])["result"] is True
    assert guest.ask("/rosapi/topic_type", {})["values"] == {"type": ""}
    guest.send(op="call_service", service="/rosapi/topics", args=None)
    assert guest.read()[0]["result"] is True


@pytest.mark.parametrize("args", ["text", 7, {"topic": 7}, {"topic": None}, [["/chatter"]], True])
def test_wrong_arguments_fail_the_call(guest: Guest, args: object) -> None:
    answer = guest.ask("/rosapi/topic_type", args)
    assert answer["result"] is False
    assert "/rosapi/topic_type" in answer["values"]


# --- parameters


@pytest.mark.parametrize("value", [1, 2.5, "text", None, [1, 2], {"a": {"b": True}}])
def test_a_parameter_keeps_its_value(guest: Guest, value: object) -> None:
    assert guest.rosapi("has_param", name="/p") == {"exists": False}
    guest.rosapi("set_param", name="p", value=json.dumps(value))
    assert json.loads(guest.rosapi("get_param", name="/p")["value"]) == value
    assert guest.rosapi("has_param", name="p") == {"exists": True}
    assert guest.rosapi("get_param_names") == {"names": ["/p"]}
    guest.rosapi("delete_param", name="/p")
    assert guest.rosapi("has_param", name="/p") == {"exists": False}
    guest.rosapi("delete_param", name="/p")


def test_a_parameter_that_is_not_there_is_its_default_or_null(guest: Guest) -> None:
    assert guest.rosapi("get_param", name="/p") == {"value": "null"}
    assert guest.rosapi("get_param", name="/p", default="[1]") == {"value": "[1]"}


def test_parameters_outlive_their_client(room: Room, guest: Guest) -> None:
    guest.rosapi("set_param", name="/p", value="1")
    guest.leave()
    assert room.enter().rosapi("get_param", name="/p") == {"value": "1"}


@pytest.mark.parametrize("value", ["", "text", "{", "NaN", "1e999", "[" * 100 + "]" * 100])
def test_what_is_no_json_is_no_parameter(guest: Guest, value: str) -> None:
    answer = guest.ask("/rosapi/set_param", {"name": "/p", "value": value})
    assert answer["result"] is False
    assert guest.rosapi("get_param_names") == {"names": []}


def test_parameters_are_bounded_in_number_and_size() -> None:
    guest = Room(parameters=2, parameter_bytes=20).enter()

    def can_set(name: str, value: object) -> bool:
        return bool(guest.ask("/rosapi/set_param", {"name": name, "value": json.dumps(value)})["result"])

    assert can_set("/a", "x" * 8)
    assert not can_set("/b", "x" * 9)
    assert can_set("/b", "x" * 8)
    assert not can_set("/c", 1)
    assert not can_set("/a", "x" * 9)
    guest.rosapi("delete_param", name="/b")
    assert can_set("/a", "x" * 18)
    assert not can_set("/" + "n" * 255, 1)
    assert not can_set("", 1)
