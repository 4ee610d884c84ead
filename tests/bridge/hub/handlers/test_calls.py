"""Calls between clients: client -> hub -> serving client -> hub -> client."""

from typing import Any

import pytest

from tests.bridge.hub.broker_harness import Guest, Room


def _serve(guest: Guest, service: str = "/add", type_name: str = "a/Add") -> None:
    guest.send(op="advertise_service", service=service, type=type_name)


def _request(server: Guest) -> dict[str, Any]:
    (request,) = server.read()
    assert request["op"] == "call_service"
    return request


def test_a_call_and_its_answer() -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", args={"a": 1, "b": 2}, id="call:7")
    request = _request(server)
    assert (request["service"], request["args"]) == ("/add", {"a": 1, "b": 2})
    assert caller.read() == []
    room.check()
    server.send(op="service_response", service="/add", id=request["id"], values={"sum": 3}, result=True)
    assert caller.read() == [
        {"op": "service_response", "id": "call:7", "service": "/add", "values": {"sum": 3}, "result": True}
    ]
    room.check()


@pytest.mark.parametrize("identifier", ["x", 7, None])
def test_the_answer_has_the_id_and_the_name_that_the_caller_used(identifier: str | int | None) -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="add", **({} if identifier is None else {"id": identifier}))
    server.send(op="service_response", service="/add", id=_request(server)["id"], values={}, result=True)
    (answer,) = caller.read()
    assert answer["service"] == "add"
    assert answer.get("id") == identifier
    assert ("id" in answer) == (identifier is not None)


@pytest.mark.parametrize("args", [{}, {"a": [1, {"b": None}]}, [1, 2]])
def test_arguments_pass_as_they_are(args: object) -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", args=args)
    assert _request(server)["args"] == args


def test_answers_may_come_in_any_order() -> None:
    room = Room()
    server, one, other = room.enter(), room.enter(), room.enter()
    _serve(server)
    one.send(op="call_service", service="/add", id="same")
    other.send(op="call_service", service="/add", id="same")
    first, second = server.read()
    server.send(op="service_response", id=second["id"], values={"n": 2}, result=True)
    server.send(op="service_response", id=first["id"], values={"n": 1}, result=True)
    assert [answer["values"] for answer in one.read()] == [{"n": 1}]
    assert [answer["values"] for answer in other.read()] == [{"n": 2}]


def test_a_client_can_call_itself() -> None:
    guest = Room().enter()
    _serve(guest)
    guest.send(op="call_service", service="/add", id=1)
    guest.send(op="service_response", id=_request(guest)["id"], values={"n": 1}, result=True)
    assert guest.read()[0]["values"] == {"n": 1}


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ("no such thing", "no such thing"),
        ({"error": 5}, '{"error":5}'),
        (None, "null"),
    ],
)
def test_a_refusal_is_told_as_a_string(values: object, told: str) -> None:
    room = Room(ros_version=2)
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add")
    server.send(op="service_response", id=_request(server)["id"], values=values, result=False)
    (answer,) = caller.read()
    assert answer["result"] is False
    assert told in answer["values"]


def test_as_in_ros_1_an_answer_is_passed_on_whatever_its_result() -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add")
    server.send(op="service_response", id=_request(server)["id"], values={"sum": 3}, result=False)
    (answer,) = caller.read()
    assert (answer["values"], answer["result"]) == ({"sum": 3}, True)
    caller.send(op="call_service", service="/add")
    server.send(op="service_response", id=_request(server)["id"], result=False)
    assert caller.read()[0]["result"] is False


@pytest.mark.parametrize("values", ["text", 3, [1], None])
def test_values_that_are_no_object_fail_the_call(values: object) -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add")
    server.send(op="service_response", id=_request(server)["id"], values=values, result=True)
    (answer,) = caller.read()
    assert answer["result"] is False
    assert "/add" in answer["values"]


def test_a_service_that_is_not_there() -> None:
    answer = Room().enter().ask("/nowhere", id=3)
    assert answer == {
        "op": "service_response",
        "id": 3,
        "service": "/nowhere",
        "values": "Service /nowhere does not exist",
        "result": False,
    }


def test_a_call_without_an_answer_fails_in_time() -> None:
    room = Room(call_timeout=10)
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id="long")
    caller.send(op="call_service", service="/add", id="short", timeout=2.5)
    caller.send(op="call_service", service="/add", id="longer", timeout=1000)
    requests = server.read()
    room.pass_time(2.4)
    assert caller.read() == []
    room.pass_time(0.2)
    room.check()
    (answer,) = caller.read()
    assert (answer["id"], answer["result"]) == ("short", False)
    assert "/add" in answer["values"]
    room.pass_time(8)
    assert [answer["id"] for answer in caller.read()] == ["long", "longer"]
    server.send(op="service_response", id=requests[0]["id"], values={}, result=True)  # too late
    assert caller.read() == []
    assert server.client.refused == 1
    room.check()


def test_a_server_that_vanishes_fails_its_calls_at_once() -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id=1)
    server.leave()
    (answer,) = caller.read()
    assert answer["result"] is False
    assert "/add" in answer["values"]
    assert caller.ask("/add")["values"] == "Service /add does not exist"
    room.check()


def test_a_caller_that_vanishes_is_not_answered() -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id=1)
    request = _request(server)
    caller.leave()
    room.check()
    server.send(op="service_response", id=request["id"], values={}, result=True)
    assert server.client.refused == 1
    room.pass_time(1000)
    room.check()


def test_a_client_that_serves_itself_and_vanishes_leaves_nothing() -> None:
    room = Room()
    guest = room.enter()
    _serve(guest)
    guest.send(op="call_service", service="/add", id=1)
    guest.leave()
    assert not room.broker._calls.pending
    assert not room.broker.graph.services
    room.check()


def test_only_who_was_asked_can_answer() -> None:
    room = Room()
    server, caller, liar = room.enter(), room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id=1)
    request = _request(server)
    liar.send(op="service_response", id=request["id"], values={"n": 666}, result=True)
    assert caller.read() == []
    server.send(op="service_response", id=request["id"], values={"n": 1}, result=True)
    server.send(op="service_response", id=request["id"], values={"n": 2}, result=True)
    assert [answer["values"] for answer in caller.read()] == [{"n": 1}]


def test_the_newest_offer_of_a_service_counts() -> None:
    room = Room()
    old, new, caller = room.enter(), room.enter(), room.enter()
    _serve(old)
    caller.send(op="call_service", service="/add", id="old")
    _serve(new)
    caller.send(op="call_service", service="/add", id="new")
    assert len(old.read()) == len(new.read()) == 1
    room.check()
    old.leave()
    assert "/add" in room.broker.graph.services
    room.check()


def test_a_service_can_be_withdrawn_by_its_owner_alone() -> None:
    room = Room()
    server, other = room.enter(), room.enter()
    _serve(server)
    other.send(op="unadvertise_service", service="/add")
    assert "/add" in room.broker.graph.services
    server.send(op="unadvertise_service", service="add")
    assert other.ask("/add")["result"] is False
    assert (server.client.refused, other.client.refused) == (0, 1)
    room.check()


def test_a_withdrawn_service_still_answers_what_it_was_asked() -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id=1)
    request = _request(server)
    server.send(op="unadvertise_service", service="/add")
    server.send(op="service_response", id=request["id"], values={"n": 1}, result=True)
    assert caller.read()[0]["values"] == {"n": 1}


@pytest.mark.parametrize(
    "operation",
    [
        {"op": "advertise_service", "service": "/rosapi/topics", "type": "a/B"},
        {"op": "advertise_service", "service": "rosapi/new", "type": "a/B"},
        {"op": "advertise_service", "service": "/a b", "type": "a/B"},
        {"op": "advertise_service", "service": "/s"},
        {"op": "advertise_service", "service": "/s", "type": "nonsense"},
        {"op": "call_service"},
        {"op": "call_service", "service": 7},
        {"op": "call_service", "service": "/s", "id": 1.5},
        {"op": "service_response", "id": 7, "values": {}, "result": True},
        {"op": "service_response", "values": {}, "result": True},
    ],
)
def test_what_is_wrong_is_refused_without_a_word(operation: dict[str, Any]) -> None:
    room = Room()
    guest = room.enter()
    guest.send(**operation)
    assert guest.read() == []
    assert guest.client.refused == 1
    assert not room.broker.graph.services


def test_a_timeout_that_is_no_number_fails_the_call() -> None:
    room = Room()
    server, caller = room.enter(), room.enter()
    _serve(server)
    assert caller.ask("/add", timeout="soon")["result"] is False
    assert server.read() == []


def test_services_and_calls_are_counted() -> None:
    room = Room(services_per_client=2, calls_per_client=3)
    server, one, other = room.enter(), room.enter(), room.enter()
    for index in range(4):
        _serve(server, f"/s{index}")
    assert list(room.broker.graph.services) == ["/s0", "/s1"]
    _serve(server, "/s0")
    assert server.client.refused == 2, "what is offered already can be repeated"
    for index in range(4):
        one.send(op="call_service", service="/s0", id=index)
    (answer,) = one.read()
    assert (answer["id"], answer["result"]) == (3, False)
    assert other.ask("/s1")["result"] is False, "the server has three to answer"
    server.send(op="service_response", id=server.read()[0]["id"], values={}, result=True)
    other.send(op="call_service", service="/s1", id=9)
    assert len(server.read()) == 1
    room.check()


def test_an_answer_that_is_too_large_fails_the_call() -> None:
    room = Room(message_bytes=500)
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id="i" * 100)
    request = _request(server)
    server.send(op="service_response", id=request["id"], values={"a": "x" * 380}, result=True)
    (answer,) = caller.read()
    assert (answer["id"], answer["result"]) == ("i" * 100, False)


def test_a_reason_that_is_too_large_is_cut() -> None:
    room = Room(message_bytes=800)
    server, caller = room.enter(), room.enter()
    _serve(server)
    caller.send(op="call_service", service="/add", id="i" * 100)
    server.send(op="service_response", id=_request(server)["id"], values="x" * 700, result=False)
    (answer,) = caller.read()
    assert (answer["values"], answer["result"]) == ("x" * 100, False)


def test_a_name_of_nearly_the_limit_is_answered() -> None:
    caller = Room(message_bytes=1000).enter()
    answer = caller.ask("/" + "x" * 700)
    assert answer["result"] is False


def test_a_request_that_is_too_large_fails_the_call() -> None:
    room = Room(message_bytes=500)
    server, caller = room.enter(), room.enter()
    _serve(server)
    data = b'{"op":"call_service","service":"/add","args":[%b]}' % b",".join([b"1e15"] * 50)
    caller.send_raw(data)
    assert server.read() == []
    assert caller.read()[0]["result"] is False


def test_who_reads_no_answers_is_doomed() -> None:
    room = Room(message_bytes=1000, client_bytes=4000)
    reader, deaf = room.enter(), room.enter()
    for _ in range(100):
        deaf.send(op="call_service", service="/rosapi/get_time")
        reader.rosapi("get_time")
    room.check()
    assert deaf.client.close_reason
    assert deaf.client in room.broker.take_ready()
    assert not reader.client.close_reason
