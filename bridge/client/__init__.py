"""The asyncio rosbridge client."""

from bridge.client.ros import Goal, Message, Publication, Qos, Ros, Service, State, Subscription, connect

__all__ = ["Goal", "Message", "Publication", "Qos", "Ros", "Service", "State", "Subscription", "connect"]
