"""Calls between clients: client -> hub -> serving client -> hub -> client."""

from typing import Any

import pytest

from tests.bridge.hub.broker_harness import Harness, Peer


def serve(peer: Peer, service: str = "/add", type_name: str = "a/Add") -> None:
    peer.send(op="advertise_service", service=service, type=type_name)


def request_of(server: Peer) -> dict[str, Any]:
    (request,) = server.read()
    assert request["op"] == "call_service"
    return request


def respond(server: Peer, **answer: Any) -> None:
    server.send(op="service_response", id=request_of(server)["id"], **answer)


class Service:
    """A hub with a client that serves /add, and one that calls it."""

    def __init__(self, **options: Any) -> None:
        self.hub = Harness(**options)
        self.server, self.caller = self.hub.connect(), self.hub.connect()
        serve(self.server)

    def call(self, **more: Any) -> None:
        self.caller.send(op="call_service", service="/add", **more)

    def answered(self, **answer: Any) -> dict[str, Any]:
        """Call, answer the request, and return the answer that the caller gets."""
        self.call()
        respond(self.server, **answer)
        (arrived,) = self.caller.read()
        return arrived


@pytest.fixture
def service() -> Service:
    return Service()


@pytest.mark.parametrize("args", [{"a": 1, "b": 2}, {}, {"a": [1, {"b": None}]}, [1, 2]])
@pytest.mark.parametrize(
    "called", [{"service": "add"}, {"service": "/add", "id": 7}, {"service": "/add", "id": "x"}]
)
def test_a_call_and_its_answer_with_the_id_and_the_name_that_the_caller_used(
    service: Service, args: object, called: dict[str, Any]
) -> None:
    service.caller.send(op="call_service", args=args, **called)
    request = request_of(service.server)
    assert (request["service"], request["args"]) == ("/add", args)
    assert service.caller.read() == []
    service.server.send(op="service_response", id=request["id"], values={"sum": 3}, result=True)
    assert service.caller.read() == [
        {"op": "service_response", "values": {"sum": 3}, "result": True, **called}
    ]


def test_answers_may_come_in_any_order(service: Service) -> None:
    other = service.hub.connect()
    service.call(id="same")
    other.send(op="call_service", service="/add", id="same")
    first, second = service.server.read()
    for number, request in ((2, second), (1, first)):
        service.server.send(op="service_response", id=request["id"], values={"n": number}, result=True)
    assert [answer["values"] for answer in service.caller.read()] == [{"n": 1}]
    assert [answer["values"] for answer in other.read()] == [{"n": 2}]


def test_a_client_can_call_itself_and_leaves_nothing(service: Service) -> None:
    server = service.server
    server.send(op="call_service", service="/add", id=1)
    respond(server, values={"n": 1}, result=True)
    assert server.read()[0]["values"] == {"n": 1}
    server.send(op="call_service", service="/add", id=2)
    server.disconnect()
    assert not service.hub.broker._calls.pending
    assert not service.hub.broker.graph.services


@pytest.mark.parametrize(
    ("values", "reason"), [("no such thing", "no such thing"), ({"error": 5}, '{"error":5}'), (None, "null")]
)
def test_a_refusal_is_a_string(values: object, reason: str) -> None:
    answer = Service(ros_version=2).answered(values=values, result=False)
    assert (answer["result"], answer["values"]) == (False, reason)


def test_as_in_ros_1_an_answer_is_passed_on_whatever_its_result(service: Service) -> None:
    answer = service.answered(values={"sum": 3}, result=False)
    assert (answer["values"], answer["result"]) == ({"sum": 3}, True)
    assert service.answered(result=False)["result"] is False


@pytest.mark.parametrize("values", ["text", 3, [1], None])
def test_values_that_are_not_an_object_fail_the_call(service: Service, values: object) -> None:
    assert service.answered(values=values, result=True)["result"] is False


def test_a_service_that_does_not_exist() -> None:
    assert Harness().connect().ask("/nowhere", id=3) == {
        "op": "service_response",
        "id": 3,
        "service": "/nowhere",
        "values": "Service /nowhere does not exist",
        "result": False,
    }


def test_a_call_without_an_answer_fails_in_time() -> None:
    service = Service(call_timeout=10)
    for identifier, timeout in (("long", 0), ("short", 2.5), ("longer", 1000)):
        service.call(id=identifier, timeout=timeout)
    requests = service.server.read()
    service.hub.advance(2.4)
    assert service.caller.read() == []
    service.hub.advance(0.2)
    (answer,) = service.caller.read()
    assert (answer["id"], answer["result"]) == ("short", False)
    service.hub.advance(8)
    assert [answer["id"] for answer in service.caller.read()] == ["long", "longer"]
    service.server.send(op="service_response", id=requests[0]["id"], values={}, result=True)  # too late
    assert service.caller.read() == []
    assert service.server.client.refused == 1


def test_deadlines_of_answered_calls_do_not_accumulate(service: Service) -> None:
    service.call(id="slow")
    (slow,) = service.server.read()
    for _ in range(1000):
        service.answered(values={})
    assert len(service.hub.broker._calls._deadlines) < 100
    service.hub.advance(61)
    assert [answer["id"] for answer in service.caller.read()] == ["slow"]
    assert slow["id"] not in service.hub.broker._calls.pending


def test_a_server_that_vanishes_fails_its_calls_at_once(service: Service) -> None:
    service.call(id=1)
    service.server.disconnect()
    (answer,) = service.caller.read()
    assert answer["result"] is False
    assert service.caller.ask("/add")["result"] is False


def test_a_caller_that_vanishes_is_not_answered(service: Service) -> None:
    service.call(id=1)
    service.caller.disconnect()
    respond(service.server, values={}, result=True)
    assert service.server.client.refused == 1
    service.hub.advance(1000)


def test_only_the_server_can_answer_and_only_once(service: Service) -> None:
    service.call(id=1)
    request = request_of(service.server)
    for peer, number in ((service.hub.connect(), 666), (service.server, 1), (service.server, 2)):
        peer.send(op="service_response", id=request["id"], values={"n": number}, result=True)
    assert [answer["values"] for answer in service.caller.read()] == [{"n": 1}]


def test_the_newest_offer_of_a_service_counts(service: Service) -> None:
    new = service.hub.connect()
    service.call(id="old")
    serve(new)
    service.call(id="new")
    assert len(service.server.read()) == len(new.read()) == 1
    service.server.disconnect()
    assert "/add" in service.hub.broker.graph.services


def test_a_service_is_withdrawn_by_its_owner_alone_and_still_answers_pending_calls(service: Service) -> None:
    other = service.hub.connect()
    service.call(id=1)
    other.send(op="unadvertise_service", service="/add")
    assert "/add" in service.hub.broker.graph.services
    service.server.send(op="unadvertise_service", service="add")
    assert other.ask("/add")["result"] is False
    assert (service.server.client.refused, other.client.refused) == (0, 1)
    respond(service.server, values={"n": 1}, result=True)
    assert service.caller.read()[0]["values"] == {"n": 1}


def test_a_timeout_that_is_not_a_number_fails_the_call(service: Service) -> None:
    assert service.caller.ask("/add", timeout="soon")["result"] is False
    assert service.server.read() == []


def test_services_and_calls_are_counted() -> None:
    service = Service(services_per_client=2, calls_per_client=3)
    server, caller, other = service.server, service.caller, service.hub.connect()
    for index in range(1, 4):
        serve(server, f"/s{index}")
    assert list(service.hub.broker.graph.services) == ["/add", "/s1"]
    serve(server)
    assert server.client.refused == 2, "an existing offer can be repeated"
    for index in range(4):
        service.call(id=index)
    (answer,) = caller.read()
    assert (answer["id"], answer["result"]) == (3, False)
    assert other.ask("/s1")["result"] is False, "the server has three calls to answer"
    server.send(op="service_response", id=server.read()[0]["id"], values={}, result=True)
    other.send(op="call_service", service="/s1", id=9)
    assert len(server.read()) == 1


def test_an_answer_or_a_request_that_is_too_large_fails_the_call() -> None:
    service = Service(message_bytes=500)
    service.call(id="i" * 100)
    respond(service.server, values={"a": "x" * 380}, result=True)
    (answer,) = service.caller.read()
    assert (answer["id"], answer["result"]) == ("i" * 100, False)
    service.caller.send_raw(b'{"op":"call_service","service":"/add","args":[%b]}' % b",".join([b"1e15"] * 50))
    assert service.server.read() == []
    assert service.caller.read()[0]["result"] is False


def test_a_failure_fits_into_a_message() -> None:
    service = Service(message_bytes=800)
    answer = service.answered(values="x" * 700, result=False)
    assert (answer["values"], answer["result"]) == ("x" * 100, False)
    assert service.caller.ask("/" + "x" * 600)["result"] is False


def test_a_client_that_reads_no_answers_must_be_closed() -> None:
    hub = Harness(message_bytes=1000, client_bytes=4000)
    reader, deaf = hub.connect(), hub.connect()
    for _ in range(100):
        deaf.send(op="call_service", service="/rosapi/get_time")
        reader.rosapi("get_time")
    assert deaf.client in hub.broker.take_ready()
    assert (bool(deaf.client.close_reason), bool(reader.client.close_reason)) == (True, False)


def test_a_client_waits_for_at_most_as_many_calls_as_the_limit() -> None:
    service = Service(calls_per_client=2)
    other = service.hub.connect()
    serve(other, "/multiply")
    for name in ("/add", "/multiply", "/add"):  # so that no server reaches its own limit first
        service.caller.send(op="call_service", service=name)
    assert len(service.server.read()) == len(other.read()) == 1
    (refused,) = service.caller.read()
    assert refused["result"] is False
