"""The rosbridge client as a state machine: objects in, events and bytes out, no socket and no clock anywhere.

What a client wants (advertisements, subscriptions, served services) is kept here, so that `ClientCore.restore` can
say it all again to a server that has forgotten it.

Source: the rosbridge protocol, version 2 (https://github.com/RobotWebTools/rosbridge_suite), and what its
servers really do (``docs/reference/rosbridge-differences.md``).
"""

from bridge.client.protocol.client_core import ClientCore
from bridge.client.protocol.subscription_options import Compression, Delivery
from bridge.client.protocol.wire import RosVersion

__all__ = ["ClientCore", "Compression", "Delivery", "RosVersion"]
