"""A broker without sockets for tests, its clients, and the invariants that are checked after each of their steps."""

import base64
import io
import json
from dataclasses import dataclass
from math import inf

from PIL import Image

from bridge.codecs import cbor_codec
from bridge.hub.broker import Broker
from bridge.hub.graph import Client
from bridge.hub.limits import HubLimits
from bridge.hub.outbox import is_text

WALL_CLOCK = 1_700_000_000_123_456_789


def _no_constant(name):
    raise AssertionError(f"{name} went onto the wire")


@dataclass(eq=False)
class Peer:
    """A client of a broker without sockets."""

    hub: "Harness"
    client: Client

    def send(self, **operation):
        self.send_raw(json.dumps(operation).encode())

    def send_raw(self, data):
        self.hub.broker.receive(self.client, data, self.hub.now)
        self.hub.check()

    def advertise(self, topic, type_name="a/B", **more):
        self.send(op="advertise", topic=topic, type=type_name, **more)

    def publish(self, topic, msg=None, **more):
        self.send(op="publish", topic=topic, msg={} if msg is None else msg, **more)

    def subscribe(self, topic, **more):
        self.send(op="subscribe", topic=topic, **more)

    def payloads(self):
        """Drain its outbox, as a socket that accepts everything does."""
        payloads = list(iter(self.client.outbox.pop, None))
        assert all(len(payload) <= self.hub.broker.limits.message_bytes for payload in payloads)
        return payloads

    def read(self):
        """Drain its outbox of operations."""
        return [
            json.loads(payload, parse_constant=_no_constant)
            if is_text(payload)
            else cbor_codec.decode(payload)
            for payload in self.payloads()
        ]

    def messages(self, topic=None):
        """Drain its outbox of messages, of one topic or all; anything else is an error."""
        operations = self.read()
        assert all(set(operation) == {"op", "topic", "msg"} for operation in operations), operations
        assert {operation["op"] for operation in operations} <= {"publish"}
        return [operation["msg"] for operation in operations if topic in {None, operation["topic"]}]

    def ask(self, service, args=None, **more):
        """Call a service that the broker answers, and return the answer."""
        self.send(op="call_service", service=service, args={} if args is None else args, **more)
        (answer,) = self.read()
        assert answer["op"] == "service_response"
        return answer

    def rosapi(self, service, /, **args):
        answer = self.ask(f"/rosapi/{service}", args)
        assert answer["result"] is True, answer
        return answer["values"]

    def disconnect(self):
        self.hub.broker.disconnect(self.client)
        self.hub.check()


class Harness:
    """A broker, and the time."""

    def __init__(self, *, ros_version=1, **limits):
        self.broker = Broker(HubLimits(**limits), ros_version=ros_version, wall_clock=lambda: WALL_CLOCK)
        self.now = 1000.0

    def connect(self, address="127.0.0.1"):
        return Peer(self, self.broker.connect(address))

    def advance(self, seconds):
        """Advance the clock, waking the broker at its deadlines."""
        end = self.now + seconds
        while self.broker.deadline <= end:
            self.now = max(self.now, self.broker.deadline)
            self.broker.wake(self.now)
            assert self.broker.deadline > self.now, "a wake that leaves work undone would busy-wait"
        self.now = end
        self.check()

    def check(self):
        """Check the invariants."""
        broker, graph, limits = self.broker, self.broker.graph, self.broker.limits
        clients = set(graph.clients.values())
        assert len(graph.topics) <= limits.topics
        for name, topic in graph.topics.items():
            assert topic.name == name
            assert name.startswith("/")
            assert topic.advertisements or topic.subscriptions, "a topic of nobody"
            assert set(topic.advertisements) | set(topic.subscriptions) <= clients
            assert topic.latching == any(each.latching for each in topic.advertisements.values())
            assert topic.latched is None or topic.latching
            assert topic.type or not topic.advertisements, "published without a type"
            for client, advertisement in topic.advertisements.items():
                assert client.advertisements[name] is advertisement
                assert advertisement.ids
            for client, subscription in topic.subscriptions.items():
                assert client.subscriptions[name] is subscription
                assert subscription.options
        assert graph.latched_bytes == sum(len(topic.latched or b"") for topic in graph.topics.values())
        assert graph.latched_bytes <= limits.latched_bytes
        for name, offer in [*graph.services.items(), *graph.actions.items()]:
            assert offer.name == name
            assert name in offer.client.services | offer.client.actions
        calls, goals = broker._calls.pending, broker._actions.goals
        for client in clients:
            assert all(graph.actions[name].client is client for name in client.actions)
            assert len(client.actions) <= limits.services_per_client
            assert set(client.goals.values()) == {
                key for key, goal in goals.items() if goal.caller.client is client
            }
            assert client.tasks == {key for key, goal in goals.items() if goal.server is client}
            assert max(len(client.goals), len(client.tasks)) <= limits.goals_per_client
            assert all(graph.topics[name].advertisements[client] for name in client.advertisements)
            assert all(graph.topics[name].subscriptions[client] for name in client.subscriptions)
            assert client.open_advertisements == sum(len(a.ids) for a in client.advertisements.values())
            assert client.open_advertisements <= limits.advertisements_per_client
            assert client.open_subscriptions == sum(len(s.options) for s in client.subscriptions.values())
            assert client.open_subscriptions <= limits.subscriptions_per_client
            assert all(graph.services[name].client is client for name in client.services)
            assert len(client.services) <= limits.services_per_client
            assert client.calls == {key for key, call in calls.items() if call.caller.client is client}
            assert client.requests == {key for key, call in calls.items() if call.server is client}
            assert max(len(client.calls), len(client.requests)) <= limits.calls_per_client
            self._check_outbox(client)
        assert all(call.caller.client in clients and call.server in clients for call in calls.values())
        assert all(goal.caller.client in clients and goal.server in clients for goal in goals.values())
        deadlines = [call.deadline for call in calls.values()]
        deadlines += [client.outbox.deadline for client in clients]
        assert broker.deadline <= min(deadlines, default=inf), "the broker would be woken too late"

    def _check_outbox(self, client):
        outbox = client.outbox
        entries = [entry for entry in outbox._entries if entry.payload is not None]
        lanes = {subscription.lane for subscription in client.subscriptions.values()}
        own = {client.status_lane, None}  # and those of goals' feedback, which outlive their goals
        over = {entry.lane for entry in entries if entry.lane not in lanes | own}
        assert all(
            any(op in (entry.payload or b"") for op in (b'"op":"action_feedback"', b'"op":"png"'))
            for entry in entries
            if entry.lane in over
        )
        assert len(outbox) == len(entries)
        held = sum(len(payload) for lane in lanes for payload in lane.held)
        cutting = outbox._cutting if outbox._fragments is not None else 0
        assert outbox.size == sum(len(entry.payload or b"") for entry in entries) + held + cutting
        assert outbox.size <= self.broker.limits.client_bytes
        assert outbox.deadline <= min((lane.next_time for lane in lanes if lane.held), default=inf)
        for lane in lanes:
            assert list(lane.queued) == [entry for entry in entries if entry.lane is lane]
            assert len(lane.queued) <= max(lane.queue_length, 1)
            assert len(lane.held) <= lane.queue_length
            assert lane.queue_length <= self.broker.limits.longest_queue


def publisher_and_subscriber(type_name, ros_version=1, limits=None, **wish):
    """Connect a client that advertises /t to a new hub, and one that subscribes to it with a wish."""
    hub = Harness(ros_version=ros_version, **limits or {})
    publisher, subscriber = hub.connect(), hub.connect()
    publisher.advertise("/t", type_name)
    subscriber.subscribe("/t", **wish)
    return publisher, subscriber


def unpacked(operation):
    """Return the operation in a picture, in the reading of Pillow."""
    picture = Image.open(io.BytesIO(base64.b64decode(operation["data"])))
    assert picture.mode == "RGB"
    return json.loads(picture.tobytes())
