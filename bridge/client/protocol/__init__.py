"""The rosbridge client as a state machine without sockets and clocks: objects in, events and bytes out.

It stores the client's advertisements, subscriptions and services, so that `ClientCore.restore` can repeat
them on a new connection.

Source: the rosbridge protocol, version 2 (https://github.com/RobotWebTools/rosbridge_suite), and
the deviations of servers from it (`docs/reference/rosbridge-differences.md`).
"""

from bridge.client.protocol.client_core import ClientCore
from bridge.client.protocol.subscription_options import Compression, Delivery
from bridge.client.protocol.wire import RosVersion

__all__ = ["ClientCore", "Compression", "Delivery", "RosVersion"]
