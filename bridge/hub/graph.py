"""State of the hub: its clients, and the topics, services and actions between them.

The graph keeps its parts consistent; handlers decide what clients may do. Topics, services and actions are stored
under their absolute name. A client that omits the leading slash means the same topic, and receives messages under the
name that it used.
"""

from dataclasses import dataclass, field

from bridge.codecs.fragments import Reassembler
from bridge.hub.delivery.encodings import Compression
from bridge.hub.delivery.outbox import Lane, Outbox
from bridge.hub.operations import OperationId


@dataclass(eq=False, slots=True)
class Client:
    """One connection."""

    number: int
    """1, 2, ... in the order of connecting."""
    address: str
    """Its network address, for the log and `service_host`."""
    outbox: Outbox
    advertisements: dict[str, "Advertisement"] = field(default_factory=dict)
    """By the topic's absolute name."""
    subscriptions: dict[str, "Subscription"] = field(default_factory=dict)
    """By the topic's absolute name."""
    open_advertisements: int = 0
    """Open advertise operations, over all topics."""
    open_subscriptions: int = 0
    """Open subscribe operations, over all topics."""
    services: set[str] = field(default_factory=set)
    """Absolute names of the services that it offers."""
    calls: set[str] = field(default_factory=set)
    """Keys of the calls whose answers it waits for."""
    requests: set[str] = field(default_factory=set)
    """Keys of the calls that it has yet to answer."""
    actions: set[str] = field(default_factory=set)
    """Absolute names of the actions that it offers."""
    goals: dict[OperationId, str] = field(default_factory=dict)
    """Keys of the goals whose end it waits for, by its own id."""
    tasks: set[str] = field(default_factory=set)
    """Keys of the goals that it works on."""
    refused: int = 0
    """Operations of it that were refused."""
    takeovers: int = 0
    """Services and actions that it took over from other clients."""
    fragments: Reassembler | None = None
    """Its incomplete messages, once it sent a fragment."""
    wants_status: bool = False
    """Whether it asked for status messages about refusals."""
    status_lane: Lane | None = None
    """The queue of its status messages, once there was one."""
    last_published: "Advertisement | None" = None
    """The last advertisement that it published on with a known envelope."""
    envelopes: dict[bytes, "Advertisement"] = field(default_factory=dict)
    """Its advertisements by their known envelopes (see `bridge.codecs.envelope`)."""
    close_reason: str = ""
    """Why it must be disconnected, empty while it may stay."""
    is_ready: bool = False
    """Whether it is in the dispatcher's list of clients with output."""

    @property
    def node(self) -> str:
        """Return its name as a ROS node."""
        return f"/client_{self.number}"


@dataclass(eq=False, slots=True)
class Advertisement:
    """A client's publishing on one topic, over all its advertise operations."""

    client: Client
    topic: "Topic"
    latching: bool = False
    ids: set[OperationId] = field(default_factory=set)
    """Ids of the advertise operations."""
    envelope: bytes = b""
    """The bytes before its messages, once they are known."""


@dataclass(frozen=True, slots=True)
class SubscribeOptions:
    """Options of one subscribe operation."""

    throttle: float
    """Minimum seconds between messages, 0 for none."""
    queue_length: int
    compression: Compression = Compression.NONE
    fragment_size: int = 0
    """Maximum bytes of a message in one fragment, 0 for whole messages."""


@dataclass(eq=False, slots=True)
class Subscription:
    """A client's subscription to one topic, over all its subscribe operations."""

    client: Client
    topic: "Topic"
    prefix: bytes
    """The bytes before each of its messages as JSON, with the topic's name as the client uses it."""
    name: str
    """The topic's name as the client uses it."""
    lane: Lane = field(default_factory=Lane)
    compression: Compression = Compression.NONE
    typed: bool = False
    """Whether it named the type, and so fixes the topic's."""
    options: dict[OperationId, SubscribeOptions] = field(default_factory=dict)
    """By operation; the least of each applies, as on the reference server."""


@dataclass(eq=False, slots=True)
class Topic:
    """A topic that somebody publishes or subscribes to."""

    name: str
    """Absolute."""
    type: str = ""
    """As this hub's ROS version writes it; empty while nobody named it."""
    advertisements: dict[Client, Advertisement] = field(default_factory=dict)
    subscriptions: dict[Client, Subscription] = field(default_factory=dict)
    latching: bool = False
    """Whether one of its publishers latches."""
    latched: bytes | None = None
    """The last message as JSON, while a publisher latches."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A service or an action that a client offers."""

    name: str
    type: str
    client: Client


class Graph:
    """Clients by number; topics, services and actions by absolute name."""

    def __init__(self) -> None:
        self.clients: dict[int, Client] = {}
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Offer] = {}
        self.actions: dict[str, Offer] = {}
        self.latched_bytes = 0
        """Bytes of all latched messages."""

    def latch(self, topic: Topic, message: bytes | None) -> None:
        """Replace a topic's latched message; None removes it."""
        self.latched_bytes += len(message or b"") - len(topic.latched or b"")
        topic.latched = message

    def tidy(self, topic: Topic) -> None:
        """Drop the latched message, the type and the topic itself as soon as nobody keeps them."""
        topic.latching = any(advertisement.latching for advertisement in topic.advertisements.values())
        if not topic.latching:
            self.latch(topic, None)
        if not topic.advertisements and not any(each.typed for each in topic.subscriptions.values()):
            topic.type = ""
        if not topic.advertisements and not topic.subscriptions:
            self.topics.pop(topic.name, None)
