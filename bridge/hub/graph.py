"""State of the hub: the clients, topics, services and actions.

The graph keeps the state consistent. Handlers decide which operations are allowed. Topics, services and
actions are stored under their absolute names. A client may omit the leading slash of a name. Messages to
this client then also have the name without the slash.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from bridge.codecs.fragments import Reassembler
from bridge.hub.encodings import Encoding
from bridge.hub.filling import Filler
from bridge.hub.limits import OperationId
from bridge.hub.outbox import Lane, Outbox


@dataclass(eq=False, slots=True)
class Client:
    """A connected client.

    The hub gives each call and each goal an id of its own. The docstrings of the fields call this id a key.
    """

    number: int
    """The number of the client: 1, 2, ... in the order of connection."""
    address: str
    """Network address, for the log and `service_host`."""
    outbox: Outbox
    advertisements: dict[str, "Advertisement"] = field(default_factory=dict)
    """The client's advertisements, by the topic's absolute name."""
    subscriptions: dict[str, "TopicSubscription"] = field(default_factory=dict)
    """The client's subscriptions, by the topic's absolute name."""
    open_advertisements: int = 0
    """Number of the client's advertise operations, over all topics, that have not been withdrawn."""
    open_subscriptions: int = 0
    """Number of the client's subscribe operations, over all topics, that have not been withdrawn."""
    services: set[str] = field(default_factory=set)
    """Absolute names of the services that the client offers."""
    calls: set[str] = field(default_factory=set)
    """Keys of the client's own calls that have no answer yet."""
    requests: set[str] = field(default_factory=set)
    """Keys of the calls that the client must answer."""
    actions: set[str] = field(default_factory=set)
    """Absolute names of the actions that the client offers."""
    goals: dict[OperationId, str] = field(default_factory=dict)
    """Keys of the unfinished goals that the client sent, by the id that the client gave to the goal."""
    tasks: set[str] = field(default_factory=set)
    """Keys of the goals that the client executes."""
    refused: int = 0
    """Number of the client's operations that were refused."""
    takeovers: int = 0
    """Number of services and actions that the client took over from other clients."""
    fragments: Reassembler | None = None
    """The `Reassembler` of the client's fragments, or None until the client sends a fragment."""
    wants_status: bool = False
    """True if the client requested a status message about each refused operation."""
    status_lane: Lane | None = None
    """The queue of status messages to the client, or None before the first status message."""
    last_published: "Advertisement | None" = None
    """The advertisement whose envelope was learnt or used last. The hub tries this envelope first."""
    envelopes: dict[bytes, "Advertisement"] = field(default_factory=dict)
    """The client's advertisements by envelope. An envelope is the part of a publish operation before the message."""
    close_reason: str = ""
    """Reason why the hub must disconnect the client, or empty."""
    is_ready: bool = False
    """True while the client is in the dispatcher's list of clients with output."""

    @property
    def node(self) -> str:
        """The client's name as a ROS node."""
        return f"/client_{self.number}"


@dataclass(eq=False, slots=True)
class Advertisement:
    """A client's publication on one topic. It combines all advertise operations of the client for the topic."""

    client: Client
    topic: "Topic"
    filler: Filler | None
    """The `Filler` of absent fields in the messages, or None if the type of the messages is unknown."""
    latching: bool = False
    ids: set[OperationId] = field(default_factory=set)
    """Ids of the advertise operations that the client has not withdrawn."""
    envelope: bytes = b""
    """The bytes before the message in a publish operation, or empty until they are known."""


@dataclass(frozen=True, slots=True)
class SubscribeOptions:
    """Options of one subscribe operation."""

    throttle: float
    """Minimum seconds between messages, 0 for none."""
    queue_length: int
    compression: Encoding = Encoding.NONE
    fragment_size: int = 0
    """Maximum number of bytes of a message per fragment, or 0 for whole messages."""


@dataclass(eq=False, slots=True)
class TopicSubscription:
    """A client's subscription to one topic. It combines all subscribe operations of the client for the topic."""

    client: Client
    topic: "Topic"
    prefix: bytes
    """The first bytes of each publish operation sent to the client as JSON, up to the message. They contain `name`."""
    name: str
    """The topic's name as the client writes it, with or without the leading slash."""
    lane: Lane = field(default_factory=Lane)
    compression: Encoding = Encoding.NONE
    typed: bool = False
    """True if the client named the topic's type."""
    options: dict[OperationId, SubscribeOptions] = field(default_factory=dict)
    """Options of each subscribe operation, by its id. The smallest throttle, queue length and fragment size apply."""


@dataclass(eq=False, slots=True)
class Topic:
    """A topic that has publishers or subscribers."""

    name: str
    """Absolute name."""
    largest: int
    """Maximum size of a message as JSON, in bytes: `HubLimits.message_bytes` minus the rest of a publish operation."""
    type: str = ""
    """Type in the form of this hub's ROS version, or an empty string while no client has named a type."""
    advertisements: dict[Client, Advertisement] = field(default_factory=dict)
    subscriptions: dict[Client, TopicSubscription] = field(default_factory=dict)
    latching: bool = False
    """True while one of its publishers latches."""
    latched: bytes | None = None
    """The last message as JSON, or None if the topic has no latching publisher."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A service or an action that a client offers."""

    name: str
    type: str
    client: Client
    fillers: Mapping[str, Filler]
    """For each part of the type, such as `Request`, the `Filler` that adds absent fields to messages of the part.

    The mapping is empty if the type is unknown.
    """


class Graph:
    """The ROS graph of the hub.

    The key of a client is its number. The key of a topic, a service or an action is its absolute name.
    """

    def __init__(self) -> None:
        self.clients: dict[int, Client] = {}
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Offer] = {}
        self.actions: dict[str, Offer] = {}
        self.latched_bytes = 0
        """Bytes of all latched messages."""

    def latch(self, topic: Topic, message: bytes | None) -> None:
        """Replace a topic's latched message, or remove it if `message` is None."""
        self.latched_bytes += len(message or b"") - len(topic.latched or b"")
        topic.latched = message

    def tidy(self, topic: Topic) -> None:
        """Drop a topic's latched message, its type or the topic itself if no client needs it any more."""
        topic.latching = any(advertisement.latching for advertisement in topic.advertisements.values())
        if not topic.latching:
            self.latch(topic, None)
        # After its last publisher a topic may get another type, unless a subscriber has named the present one.
        if not topic.advertisements and not any(each.typed for each in topic.subscriptions.values()):
            topic.type = ""
        if not topic.advertisements and not topic.subscriptions:
            self.topics.pop(topic.name, None)
