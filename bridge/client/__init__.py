"""The asyncio rosbridge client."""

from bridge.client.ros import (
    Goal,
    GoalRequest,
    Message,
    Publication,
    Qos,
    Ros,
    Service,
    State,
    Subscription,
    connect,
)

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
