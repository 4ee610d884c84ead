"""A node of ROS 1 that publishes the messages of a file: a line each, with topic, type and base64.

    /usr/bin/python3 ros_node.py FILE

Each message is first decoded with ROS's own message classes.
"""

import base64
import sys
from pathlib import Path

import rospy
from roslib.message import get_message_class

rospy.init_node("verify_tools")
for line in Path(sys.argv[1]).read_text().splitlines():
    topic, type_name, data = line.split()
    message = get_message_class(type_name)().deserialize(base64.b64decode(data))
    rospy.Publisher(topic, type(message), queue_size=1, latch=True).publish(message)
print("published", flush=True)
rospy.spin()
