"""Calls of services and goals of actions: client -> hub -> serving client -> hub -> client, each ended exactly once."""

import pytest

from bridge.client.protocol.events import GoalStatus
from tests.bridge.hub.broker_harness import Harness, unpacked

ASKS = {"service": "call_service", "action": "send_action_goal"}
ENDS = {"service": "service_response", "action": "action_result"}
TYPES = {"service": "a/Dock", "action": "a/action/Dock"}
DOCK = "/dock"


class Docking:
    """A hub with a client that offers /dock, a service or an action, and one that asks for it."""

    def __init__(self, kind, type_name=None, *, ros_version=2, **limits):
        self.kind = kind
        self.type_name = type_name or TYPES[kind]
        self.hub = Harness(ros_version=ros_version, **limits)
        self.server, self.client = self.hub.connect(), self.hub.connect()
        self.offer(self.server)

    @property
    def offered(self):
        return self.hub.broker.graph.services if self.kind == "service" else self.hub.broker.graph.actions

    @property
    def pending(self):
        return self.hub.broker._calls.pending if self.kind == "service" else self.hub.broker._actions.goals

    def offer(self, peer, name=DOCK):
        peer.send(op=f"advertise_{self.kind}", type=self.type_name, **{self.kind: name})

    def withdraw(self, peer):
        peer.send(op=f"unadvertise_{self.kind}", **{self.kind: "dock"})

    def ask(self, identity="x", peer=None, name=DOCK, **more):
        (peer or self.client).send(op=ASKS[self.kind], id=identity, **{self.kind: name}, **more)

    def asked(self, identity="x", **more):
        """Ask, and return the key of the request at the server."""
        self.ask(identity, **more)
        (request,) = self.server.read()
        return str(request["id"])

    def end(self, key, peer=None, **answer):
        (peer or self.server).send(op=ENDS[self.kind], id=key, **answer)

    def answer(self, peer=None):
        """Return the one answer that a client got."""
        (answer,) = (peer or self.client).read()
        assert answer["op"] == ENDS[self.kind]
        return answer

    def ended(self, **answer):
        """Ask, end it, and return the answer that the client gets."""
        self.end(self.asked(), **answer)
        return self.answer()


@pytest.fixture(params=["service", "action"])
def docking(request):
    return Docking(request.param)


@pytest.fixture
def action():
    return Docking("action")


BOTH = pytest.mark.parametrize("kind", ["service", "action"])


# --- both


@pytest.mark.parametrize("args", [{"a": [1, {"b": None}]}, {}, [1, 2]])
@pytest.mark.parametrize(("name", "identity"), [("dock", {}), (DOCK, {"id": 7}), (DOCK, {"id": "x"})])
def test_an_answer_has_the_id_and_the_name_that_were_used(docking, args, name, identity):
    called = {docking.kind: name} | identity
    docking.client.send(op=ASKS[docking.kind], args=args, **called)
    (request,) = docking.server.read()
    assert (request["op"], request[docking.kind], request["args"]) == (ASKS[docking.kind], DOCK, args)
    assert docking.client.read() == []
    docking.end(request["id"], values={"sum": 3}, result=True)
    status = {"status": GoalStatus.SUCCEEDED} if docking.kind == "action" else {}
    answer = {"op": ENDS[docking.kind], "values": {"sum": 3}, "result": True}
    assert docking.answer() == answer | called | status
    assert not docking.pending


def test_answers_may_come_in_any_order_and_go_to_whoever_asked(docking):
    other = docking.hub.connect()
    keys = {peer: docking.asked("same", peer=peer) for peer in (docking.client, other)}
    for peer in (other, docking.client):
        docking.end(keys[peer], values={"n": keys[peer]}, result=True)
    assert [docking.answer(peer)["values"]["n"] for peer in keys] == list(keys.values())


@pytest.mark.parametrize(
    ("values", "result", "reason"),
    [("no such thing", False, "no such thing"), ({"error": 5}, False, '{"error":5}'), ([1], True, DOCK)],
)
def test_a_refusal_is_a_string_and_values_that_are_no_object_are_one(docking, values, result, reason):
    answer = docking.ended(values=values, result=result)
    assert answer["result"] is False
    assert reason in answer["values"]


@pytest.mark.parametrize(
    ("kind", "wish"),
    [
        ("service", {"timeout": "soon"}),
        ("action", {"action_type": "a/action/Other"}),
        ("action", {"action_type": "nonsense"}),
        ("action", {"feedback": "much"}),
        *((kind, {"name": "/nowhere"}) for kind in ASKS),
    ],
)
def test_an_impossible_wish_is_answered(kind, wish):
    docking = Docking(kind)
    docking.ask(**wish)
    assert docking.server.read() == []
    answer = docking.answer()
    assert (answer["id"], answer["result"], answer[kind]) == ("x", False, wish.get("name", DOCK))
    assert isinstance(answer["values"], str)
    assert answer.get("status") == (GoalStatus.ABORTED if kind == "action" else None)


def test_a_server_that_leaves_fails_what_it_works_on_and_leaves_nothing(docking):
    docking.ask()
    docking.ask(peer=docking.server)  # a client can ask itself
    docking.server.disconnect()
    assert docking.answer()["result"] is False
    assert not docking.pending
    assert not docking.offered
    docking.ask()
    assert docking.answer()["result"] is False


def test_a_client_that_leaves_is_not_answered_and_its_goals_are_cancelled(docking):
    key = docking.asked()
    docking.client.disconnect()
    cancelled = [{"op": "cancel_action_goal", "id": key, "action": DOCK}]
    assert docking.server.read() == (cancelled if docking.kind == "action" else [])
    docking.end(key, values={}, result=True)
    assert docking.server.client.refused == 1
    docking.hub.advance(1000)


def test_only_the_server_can_answer_and_only_once(docking):
    key = docking.asked()
    for peer, number in ((docking.hub.connect(), 666), (docking.server, 1), (docking.server, 2)):
        docking.end(key, peer, values={"n": number}, result=True)
    assert docking.answer()["values"] == {"n": 1}


def test_the_newest_offer_counts_and_its_owner_alone_withdraws_it(docking):
    new = docking.hub.connect()
    key = docking.asked("old")
    docking.offer(new)
    docking.ask("new")
    assert docking.server.read() == []
    (request,) = new.read()
    docking.withdraw(docking.server)
    assert list(docking.offered) == [DOCK]
    docking.withdraw(new)
    assert not docking.offered
    assert (docking.server.client.refused, new.client.refused) == (1, 0)
    for peer, each in ((docking.server, key), (new, request["id"])):  # what was begun may still be ended
        docking.end(each, peer, values={}, result=True)
    assert [answer["id"] for answer in docking.client.read()] == ["old", "new"]


@BOTH
def test_what_a_client_waits_for_and_what_a_server_works_on_are_counted(kind):
    docking = Docking(kind, calls_per_client=3, goals_per_client=3)
    second, other = docking.hub.connect(), docking.hub.connect()
    docking.offer(second, "/second")
    for number, name in enumerate([DOCK, "/second", DOCK, "/second"]):  # no server has too many
        docking.ask(number, name=name)
    assert (docking.answer()["id"], len(docking.pending)) == (3, 3)
    keys = [request["id"] for request in docking.server.read()]
    for number in range(2):
        docking.ask(number, peer=other)
    assert (docking.answer(other)["id"], len(docking.pending)) == (1, 4)
    docking.end(keys[0], values={}, result=True)
    docking.ask(2, peer=other)
    assert len(docking.server.read()) == 2


@BOTH
def test_offers_are_counted_and_can_be_repeated(kind):
    docking = Docking(kind, services_per_client=2)
    for name in ("/1", "/2", "/3", DOCK):
        docking.offer(docking.server, name)
    assert (list(docking.offered), docking.server.client.refused) == ([DOCK, "/1"], 2)


@BOTH
def test_what_is_too_large_fails_and_its_failure_fits(kind):
    docking = Docking(kind, message_bytes=400)
    for answer in ({"values": {"a": "x" * 250}, "result": True}, {"values": "x" * 300, "result": False}):
        docking.end(docking.asked("g" * 250), **answer)
        failed = docking.answer()
        assert (failed["id"], failed["result"]) == ("g" * 250, False)
        assert len(failed["values"]) <= 50
    docking.ask(name="/" + "x" * 200)
    assert docking.answer()["result"] is False
    growing = b",".join([b"1e15"] * 50)
    docking.client.send_raw(
        b'{"op":"%b","%b":"/dock","args":[%b]}' % (ASKS[kind].encode(), kind.encode(), growing)
    )
    assert docking.server.read() == []
    assert docking.answer()["result"] is False


def test_an_answer_needs_only_its_id(docking):
    status = {"status": GoalStatus.SUCCEEDED} if docking.kind == "action" else {}
    rest = {docking.kind: DOCK, "id": "x", "values": {}, "result": True}
    assert docking.ended() == {"op": ENDS[docking.kind]} | rest | status


# --- calls


def test_as_in_ros_1_an_answer_is_passed_on_whatever_its_result():
    service = Docking("service", ros_version=1)
    answer = service.ended(values={"sum": 3}, result=False)
    assert (answer["values"], answer["result"]) == ({"sum": 3}, True)
    assert service.ended(result=False)["result"] is False


def test_a_call_without_an_answer_fails_in_time():
    service = Docking("service", call_timeout=10)
    for identifier, timeout in (("long", 0), ("short", 2.5), ("longer", 1000)):
        service.ask(identifier, timeout=timeout)
    requests = service.server.read()
    service.hub.advance(2.4)
    assert service.client.read() == []
    service.hub.advance(0.2)
    answer = service.answer()
    assert (answer["id"], answer["result"]) == ("short", False)
    service.hub.advance(8)
    assert [answer["id"] for answer in service.client.read()] == ["long", "longer"]
    service.end(requests[0]["id"], values={}, result=True)  # too late
    assert service.client.read() == []
    assert service.server.client.refused == 1


def test_deadlines_of_answered_calls_do_not_accumulate():
    service = Docking("service")
    slow = service.asked("slow")
    for _ in range(1000):
        service.ended(values={})
    assert len(service.hub.broker._calls._deadlines) < 100
    service.hub.advance(61)
    assert service.answer()["id"] == "slow"
    assert slow not in service.pending


def test_a_client_that_reads_no_answers_must_be_closed():
    hub = Harness(message_bytes=1000, client_bytes=4000)
    reader, deaf = hub.connect(), hub.connect()
    for _ in range(100):
        deaf.send(op="call_service", service="/rosapi/get_time")
        reader.rosapi("get_time")
    assert deaf.client in hub.broker.take_ready()
    assert (bool(deaf.client.close_reason), bool(reader.client.close_reason)) == (True, False)


# --- goals


@pytest.mark.parametrize("wanted", [True, False])
def test_feedback_is_sent_only_if_requested(action, wanted):
    key = action.asked(feedback=wanted, action_type=TYPES["action"])
    feedback = {"op": "action_feedback", "action": DOCK, "id": "x"}
    for said, heard in (({"values": {"part": 1}}, {"part": 1}), ({}, {})):
        action.server.send(op="action_feedback", id=key, **said)
        assert action.client.read() == [feedback | {"values": heard}] * wanted


def test_goals_are_cancelled_by_their_server_one_or_all(action):
    keys = [action.asked(number) for number in range(3)]
    action.client.send(op="cancel_action_goal", id=0, action="dock")
    assert action.server.read() == [{"op": "cancel_action_goal", "id": keys[0], "action": DOCK}]
    action.end(keys[0], values={}, status=GoalStatus.CANCELED, result=True)
    result = action.answer()
    assert (result["id"], result["status"], result["result"]) == (0, GoalStatus.CANCELED, True)
    assert action.client.ask("/dock/_action/cancel_goal")["result"] is True
    assert [(each["op"], each["id"]) for each in action.server.read()] == [
        ("cancel_action_goal", key) for key in keys[1:]
    ]
    assert action.client.ask("/nothing/_action/cancel_goal")["result"] is False


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        ({"result": False}, GoalStatus.ABORTED),
        ({"result": False, "values": "stuck", "status": 5}, GoalStatus.CANCELED),
        ({"result": False, "values": "stuck", "status": 99}, GoalStatus.ABORTED),
        ({"result": "yes", "values": "?", "status": True}, GoalStatus.ABORTED),
    ],
)
def test_a_failed_goal_has_a_status_and_a_reason(action, answer, status):
    result = action.ended(**answer)
    assert (result["result"], result["status"]) == (False, status)
    assert answer.get("values", DOCK) in result["values"]


def test_nobody_tells_or_cancels_the_goals_of_others(action):
    stranger = action.hub.connect()
    key = action.asked()
    stranger.send(op="action_feedback", id=key, action=DOCK, values={})
    stranger.send(op="cancel_action_goal", id="x", action=DOCK)
    action.client.send(op="cancel_action_goal", id="x", action="/other")
    assert (stranger.client.refused, action.client.client.refused) == (2, 1)
    assert action.client.read() == action.server.read() == []


def test_a_slow_client_loses_feedback_but_not_the_result():
    action = Docking("action", queue_length=3)
    key = action.asked(feedback=True)
    for index in range(100):
        action.server.send(op="action_feedback", id=key, values={"i": index})
    action.end(key, values={})
    *feedback, result = action.client.read()
    assert [operation["values"]["i"] for operation in feedback] == [97, 98, 99]
    assert result["op"] == "action_result"


def test_actions_are_described_also_those_of_actionlibs_topics(action):
    assert action.client.rosapi("action_type", action="dock") == {"type": TYPES["action"]}
    for part in ("cancel", "status", "feedback", "result"):
        action.client.advertise(f"/undock/{part}")
    assert action.client.rosapi("action_servers") == {"action_servers": [DOCK]}
    action.client.subscribe("/undock/goal", type="a/B")
    assert set(action.client.rosapi("action_servers")["action_servers"]) == {"/undock", DOCK}


def test_one_goal_at_a_time_may_have_no_id(action):
    key = action.asked(None)
    action.ask(None)
    assert (refusal := action.answer())["result"] is False
    assert "id" not in refusal
    action.client.send(op="cancel_action_goal", action=DOCK)
    assert action.server.read() == [{"op": "cancel_action_goal", "id": key, "action": DOCK}]
    action.end(key, values={}, status=GoalStatus.CANCELED, result=True)
    status = {"status": GoalStatus.CANCELED}
    assert action.answer() == {"op": "action_result", "action": DOCK, "values": {}, "result": True} | status


def test_feedback_and_result_as_png(action):
    key = action.asked("g", compression="png", feedback=True)
    action.server.send(op="action_feedback", id=key, action=DOCK, values={"a": 1})
    action.end(key, values={"b": 1}, status=GoalStatus.SUCCEEDED, result=True)
    operations = [unpacked(operation) for operation in action.client.read()]
    assert [operation["values"] for operation in operations] == [{"a": 1}, {"b": 1}]


# --- absent fields


@pytest.mark.parametrize("ros_version", [1, 2])
@pytest.mark.parametrize(
    ("args", "received"),
    [
        ({"b": 2}, {"a": 0, "b": 2}),
        (None, {"a": 0, "b": 0}),
        ([], {"a": 0, "b": 0}),
        ([1], {"a": 1, "b": 0}),
        ([1, 2, 3], {"a": 1, "b": 2}),
        ("text", "text"),
    ],
)
def test_arguments_and_values_of_a_known_service_are_whole(ros_version, args, received):
    service = Docking("service", "rospy_tutorials/AddTwoInts", ros_version=ros_version)
    service.ask(args=args)
    (request,) = service.server.read()
    assert request["args"] == received
    service.end(request["id"], values={}, result=True)
    answer = service.answer()
    assert (answer["values"], answer["result"]) == ({"sum": 0}, True)


@pytest.mark.parametrize("ros_version", [1, 2])
def test_parts_of_a_known_action_are_whole(ros_version):
    action = Docking("action", "tf2_msgs/LookupTransform", ros_version=ros_version)
    action.ask(args={"timeout": {"sec": 1, "secs": 1}}, feedback=True)
    (goal,) = action.server.read()
    assert goal["args"]["timeout"]["nanosec" if ros_version == 2 else "nsecs"] == 0
    assert goal["args"]["advanced"] is False
    action.server.send(op="action_feedback", id=goal["id"], values={})
    assert action.client.read()[0]["values"] == {}
    action.end(goal["id"], values={"error": {"error": 1}}, result=True)
    values = action.answer()["values"]
    assert values["error"] == {"error": 1, "error_string": ""}
    assert values["transform"]["transform"]["rotation"]["w"] == float(ros_version == 2)


def test_values_that_outgrow_the_limit_are_refused():
    large = Docking("service", "nav_msgs/GetPlan", ros_version=1, message_bytes=300)
    large.ask()
    assert large.answer()["result"] is False
    small = Docking("service", "rospy_tutorials/AddTwoInts", ros_version=1, message_bytes=300)
    small.ask()
    assert small.server.read()[0]["args"] == {"a": 0, "b": 0}


@pytest.mark.parametrize("ros_version", [1, 2])
def test_the_reason_of_this_projects_client_is_passed_on(ros_version):
    docking = Docking("service", ros_version=ros_version)
    answer = docking.ended(values={}, result=False, reason="no room")
    assert (answer["values"], answer["result"]) == ("no room", False)
