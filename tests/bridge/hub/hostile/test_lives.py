"""Long random runs of a small hub with mostly sensible clients, in every order.

Everything that must always hold is checked after each step; every call is answered exactly once.
"""

import json
import random

from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.bridge.hub.broker_harness import Harness

_NAMES = ["/t", "t", "/u", "/u", "/v", "v", "/w", "", "a b"]
_TYPES = ["a/B", "a/msg/B", "a/B", "a/B", "a/C", "nonsense"]
_IDS = [None, None, "one", "two", 3, 1.5]
_SERVICES = ["/s", "s", "/r", "/q", "/nowhere", "/rosapi/set_param", "/rosapi/topics", "/rosapi/nodes"]
_ACTIONS = ["/a", "a", "/b", "/nowhere"]
_FORMS = ["none", "none", "png", "cbor", "cbor-raw", "bson", 7]
_WILD = [None, True, -1, 1e300, 10**400, float("nan"), "", "x" * 2000, [], {}, [{"a": [1]}]]


def _message(rng):
    if rng.random() < 0.05:
        return rng.choice(_WILD)
    return {"data": "x" * rng.choice([0, 1, 10, 100, 1000, 3300])}


def _operation(rng):
    """Return an operation that a client could send; one in twenty has an invalid field."""
    name, service = rng.choice(_NAMES), rng.choice(_SERVICES)
    kind = rng.choice(
        ["publish"] * 6
        + ["subscribe"] * 3
        + ["call_service"] * 4
        + ["advertise", "advertise", "unadvertise", "unsubscribe", "advertise_service", "advertise_service"]
        + ["unadvertise_service", "service_response", "fly", "set_level", "unadvertise_action"]
        + ["send_action_goal"] * 4
        + ["advertise_action", "advertise_action", "cancel_action_goal", "action_feedback", "action_result"]
    )
    fields = {"op": kind}
    if "action" in kind:
        fields |= {"action": rng.choice(_ACTIONS)}
    elif "service" in kind:
        fields |= {"service": service}
    else:
        fields |= {"topic": name}
    if kind in {"advertise", "advertise_service"} or (kind != "call_service" and rng.random() < 0.3):
        fields["type"] = rng.choice(_TYPES)
    if kind == "publish":
        fields["msg"] = _message(rng)
    elif kind in {"subscribe", "advertise", "unsubscribe", "unadvertise"}:
        fields["id"] = rng.choice(_IDS)
    if kind in {"advertise", "publish"}:
        fields["latch"] = rng.random() < 0.4
    if kind == "subscribe":
        fields["throttle_rate"] = rng.choice([0, 0, 50, 1000, 0.0])
        fields["queue_length"] = rng.choice([0, 1, 3, 100])
        fields["compression"] = rng.choice(_FORMS)
        fields["fragment_size"] = rng.choice([0, 0, 0, 10, 300])
    if kind == "set_level":
        fields["level"] = rng.choice(["error", "none", "louder"])
    if kind == "advertise_action":
        fields["type"] = rng.choice(["a/B", "a/action/B", "a/action/C"])
    if kind == "send_action_goal":
        fields["args"] = rng.choice([{}, {"a": "y" * 3000}])
        fields["feedback"] = rng.random() < 0.7
    if kind == "call_service":
        fields["args"] = rng.choice(
            [{}, {"name": name, "value": rng.choice(["1", "[2]", "x"])}, {"a": "y" * 3000}]
        )
        fields["timeout"] = rng.choice([0, 0, 0.5, 1])
    if rng.random() < 0.05:
        fields[rng.choice(list(fields)[1:])] = rng.choice(_WILD)
    return fields


class _Visitor:
    """A client that remembers what it was asked, and counts its own calls and their answers."""

    def __init__(self, hub):
        self.peer = hub.connect()
        self.requests = []
        self.goals = []
        self.calls = set()
        self.answered = set()

    def send(self, operation, call_number):
        service = operation.get("service")
        action = operation.get("action")
        call = operation["op"] == "call_service" and isinstance(service, str) and service
        goal = operation["op"] == "send_action_goal" and isinstance(action, str) and action
        if call or goal:
            operation["id"] = call_number
            if len(json.dumps(operation)) <= self.peer.hub.broker.limits.message_bytes:
                self.calls.add(call_number)
        self.peer.send(**operation)

    def read(self):
        for operation in self.peer.read():
            if operation["op"] == "call_service":
                self.requests.append(operation["id"])
            elif operation["op"] == "send_action_goal":
                self.goals.append(operation["id"])
            elif operation["op"] in {"cancel_action_goal", "fragment", "png", "status"}:
                pass
            elif operation["op"] == "action_feedback":
                assert operation["id"] in self.calls - self.answered, "feedback after the end, or unasked"
            elif operation["op"] in {"service_response", "action_result"}:
                assert operation["result"] is True or isinstance(operation["values"], str)
                assert operation["id"] in self.calls - self.answered, "answered twice, or never asked"
                self.answered.add(operation["id"])
            else:
                assert set(operation) == {"op", "topic", "msg"}

    def work(self, rng):
        """Say how far a goal is, or end it."""
        at = rng.randrange(len(self.goals))
        ends = rng.random() < 0.5
        self.peer.send(
            op="action_result" if ends else "action_feedback",
            id=self.goals.pop(at) if ends else self.goals[at],
            action=rng.choice(_ACTIONS),
            values=rng.choice([{}, {"a": 1}, "no", {"a": "x" * 3300}, None]),
            result=rng.random() < 0.7,
            status=rng.choice([4, 5, 6, 99]),
        )

    def answer(self, rng):
        self.peer.send(
            op="service_response",
            id=self.requests.pop(rng.randrange(len(self.requests))),
            values=rng.choice([{}, {"a": 1}, "no", {"a": "x" * 3400}, None]),
            result=rng.random() < 0.7,
        )


def _live(seed, steps):
    """One life of a hub."""
    rng = random.Random(seed)
    hub = Harness(
        topics=3,
        advertisements_per_client=4,
        subscriptions_per_client=4,
        services_per_client=2,
        calls_per_client=3,
        goals_per_client=3,
        message_bytes=3500,
        client_bytes=4000,
        latched_bytes=4000,
        queue_length=3,
        longest_queue=5,
        parameters=2,
    )
    visitors = [_Visitor(hub) for _ in range(4)]
    for number in range(steps):
        who = rng.randrange(len(visitors))
        visitor = visitors[who]
        step = rng.choices(
            ["operation", "answer", "read", "read all", "wait", "reconnect"], [60, 10, 4, 1, 10, 1]
        )[0]
        if step == "operation":
            visitor.send(_operation(rng), number)
        elif step == "answer" and visitor.requests and (not visitor.goals or rng.random() < 0.5):
            visitor.answer(rng)
        elif step == "answer" and visitor.goals:
            visitor.work(rng)
        elif step == "read":
            visitor.read()
        elif step == "read all":
            for each in visitors:
                each.read()
        elif step == "wait":
            hub.advance(rng.choice([0.01, 0.05, 1.0, 30.0]))
        elif step == "reconnect":
            visitor.peer.disconnect()
            visitors[who] = _Visitor(hub)
        ready = hub.broker.take_ready()
        assert len(set(ready)) == len(ready)
    _end(hub, visitors)


def _end(hub, visitors):
    for visitor in visitors:
        if (
            visitor.peer.client.close_reason
        ):  # as the owner of its socket would; goals that it never read fail now
            visitor.peer.disconnect()
    for _ in range(2):
        for visitor in visitors:
            visitor.read()
            for key in visitor.goals:  # a goal has no time limit: who works on it ends it, or goes
                visitor.peer.send(op="action_result", id=key, values={})
        hub.advance(120)
    for visitor in visitors:
        visitor.read()
        if not visitor.peer.client.close_reason:
            assert visitor.calls == visitor.answered, "a call without an answer"
        visitor.peer.disconnect()
        hub.check()
    graph = hub.broker.graph
    left = [graph.topics, graph.services, graph.actions, hub.broker._actions.goals, hub.broker._calls.pending]
    assert not any(left)
    hub.advance(120)
    assert not hub.broker._dispatcher.throttled


@given(st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
@example(0)
def test_a_hub_stays_well_all_its_life(seed):
    _live(seed, 400)
