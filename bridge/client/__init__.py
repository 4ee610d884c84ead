"""The asyncio rosbridge client."""

from bridge.client.actions import Goal, GoalRequest
from bridge.client.handles import Publication, Service, Subscription
from bridge.client.protocol.events import Message
from bridge.client.ros import Ros, connect
from bridge.client.session import State
from bridge.qos import Qos

__all__ = [
    "Goal",
    "GoalRequest",
    "Message",
    "Publication",
    "Qos",
    "Ros",
    "Service",
    "State",
    "Subscription",
    "connect",
]
