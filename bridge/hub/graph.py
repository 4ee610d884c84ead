"""What the hub knows: its clients, and the topics, services and actions that they have between them.

The graph keeps its parts consistent with each other; what clients may do is others' to decide.
Topics, services and actions are found by their absolute name. A client that leaves the leading slash out means
the same topic, and gets its messages under the name that it used.
"""

from dataclasses import dataclass, field

from bridge.codecs.fragments import Reassembler
from bridge.hub.delivery.encodings import Compression
from bridge.hub.delivery.outbox import Lane, Outbox
from bridge.hub.operations import OperationId
from bridge.names import same_type


@dataclass(eq=False, slots=True)
class Client:
    """One connection.

    Attributes:
        number: 1, 2, ... in the order of connecting.
        address: where from, for the log and ``service_host``.
        outbox: what waits for it.
        advertisements: what it publishes, by the topic's absolute name.
        subscriptions: what it hears, by the topic's absolute name.
        open_advertisements: advertise operations that it has open, over all topics.
        open_subscriptions: subscribe operations that it has open, over all topics.
        services: absolute names of those it offers.
        asked: keys of the calls whose answers it waits for.
        asked_of: keys of the calls that it has yet to answer.
        refused: operations that it sent in vain.
        takeovers: services and actions that it took over from other clients.
        actions: absolute names of those it offers.
        goals: keys of those it waits for the end of, by its own id.
        goals_of: keys of those it has yet to end.
        fragments: what it sent in fragments and is not complete, once it did.
        wants_status: whether it asked to be told what is refused.
        status_lane: the way of its status messages, once there was one.
        publishing: what it published last with a known envelope.
        envelopes: what it publishes, by the envelopes that are known (see `bridge.codecs.envelope`).
        doomed: why it is to be disconnected, empty while it may stay.
        has_output: whether it is on the broker's list of those to be served.
    """

    number: int
    address: str
    outbox: Outbox
    advertisements: dict[str, "Advertisement"] = field(default_factory=dict)
    subscriptions: dict[str, "Subscription"] = field(default_factory=dict)
    open_advertisements: int = 0
    open_subscriptions: int = 0
    services: set[str] = field(default_factory=set)
    asked: set[str] = field(default_factory=set)
    asked_of: set[str] = field(default_factory=set)
    refused: int = 0
    takeovers: int = 0
    actions: set[str] = field(default_factory=set)
    goals: dict[OperationId, str] = field(default_factory=dict)
    goals_of: set[str] = field(default_factory=set)
    fragments: Reassembler | None = None
    wants_status: bool = False
    status_lane: Lane | None = None
    publishing: "Advertisement | None" = None
    envelopes: dict[bytes, "Advertisement"] = field(default_factory=dict)
    doomed: str = ""
    has_output: bool = False

    @property
    def node(self) -> str:
        """What it would be called as a ROS node."""
        return f"/client_{self.number}"


@dataclass(eq=False, slots=True)
class Advertisement:
    """That a client publishes on a topic: one, however many advertise operations it sent.

    Attributes:
        client: who publishes.
        topic: where.
        latching: whether the last message is to be kept.
        ids: of the operations.
        envelope: what stands before its messages, once that is known; empty until then.
    """

    client: Client
    topic: "Topic"
    latching: bool = False
    ids: set[OperationId] = field(default_factory=set)
    envelope: bytes = b""


@dataclass(frozen=True, slots=True)
class Wish:
    """What one subscribe operation asked for.

    Attributes:
        throttle: seconds between messages, or 0.
        queue_length: messages that may wait, or 0.
        compression: the form of the messages.
        fragment_size: characters of one fragment, or 0.
    """

    throttle: float
    queue_length: int
    compression: Compression = "none"
    fragment_size: int = 0


@dataclass(eq=False, slots=True)
class Subscription:
    """That a client hears a topic: one, however many subscribe operations it sent.

    Attributes:
        client: who hears.
        topic: what.
        prefix: the beginning of each of its messages on the wire, with the topic's name as the client has it.
        name: the topic's name as the client has it.
        lane: its messages' way to the client.
        compression: the form in which they go.
        typed: whether it named the type, and so keeps the topic to it.
        wishes: by operation; the least of each counts, as on the reference server.
    """

    client: Client
    topic: "Topic"
    prefix: bytes
    name: str
    lane: Lane = field(default_factory=Lane)
    compression: Compression = "none"
    typed: bool = False
    wishes: dict[OperationId, Wish] = field(default_factory=dict)


@dataclass(eq=False, slots=True)
class Topic:
    """A topic that somebody publishes or hears.

    Attributes:
        name: absolute.
        type: as the first who named it wrote it; empty while nobody has.
        advertisements: who publishes.
        subscriptions: who hears.
        latching: whether one of its publishers latches.
        latched: the last message (its JSON) while somebody latches, else None.
    """

    name: str
    type: str = ""
    advertisements: dict[Client, Advertisement] = field(default_factory=dict)
    subscriptions: dict[Client, Subscription] = field(default_factory=dict)
    latching: bool = False
    latched: bytes | None = None


@dataclass(frozen=True, slots=True)
class Service:
    """A service that a client offers."""

    name: str
    type: str
    client: Client


@dataclass(frozen=True, slots=True)
class Action:
    """An action that a client offers."""

    name: str
    type: str
    client: Client


class Graph:
    """Clients by number; topics, services and actions by absolute name.

    Attributes:
        latched_bytes: all latched messages together.
    """

    def __init__(self) -> None:
        self.clients: dict[int, Client] = {}
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Service] = {}
        self.actions: dict[str, Action] = {}
        self.latched_bytes = 0

    def services_of_type(self, type_name: str) -> list[Service]:
        """All services of a type, in either form of its name."""
        return [service for service in self.services.values() if same_type(service.type, type_name)]

    def client_of_node(self, node: str) -> Client | None:
        """The client that a node's name means."""
        return next((client for client in self.clients.values() if client.node == node), None)

    def latch(self, topic: Topic, message: bytes | None) -> None:
        """Keep a topic's last message (None: none) in place of the one before."""
        self.latched_bytes += len(message or b"") - len(topic.latched or b"")
        topic.latched = message

    def tidy(self, topic: Topic) -> None:
        """After somebody left a topic: forget what nobody latches, a type nobody named, what nobody uses."""
        topic.latching = any(advertisement.latching for advertisement in topic.advertisements.values())
        if not topic.latching:
            self.latch(topic, None)
        if not topic.advertisements and not any(heard.typed for heard in topic.subscriptions.values()):
            topic.type = ""
        if not topic.advertisements and not topic.subscriptions:
            self.topics.pop(topic.name, None)
