"""A hand in the boat's world with roslibpy, an independent client.

    python roslibpy_hand.py URI NAME JSON

Calls the service NAME with a std_srvs/SetBool request and prints the answer, or, if NAME is `/boat/set_pose`, publishes
a geometry_msgs/PoseStamped there.
"""

import json
import sys

import roslibpy

from tests.patience import PROCESS_PATIENCE


def main(uri, name, message):
    host, port = uri.removeprefix("ws://").rsplit(":", 1)
    ros = roslibpy.Ros(host=host, port=int(port))
    ros.run(timeout=PROCESS_PATIENCE)
    if name == "/boat/set_pose":
        topic = roslibpy.Topic(ros, name, "geometry_msgs/PoseStamped")
        topic.publish(roslibpy.Message(json.loads(message)))
        # the hub performs a client's operations in order, so the pose has arrived when this is answered
        roslibpy.Service(ros, "/rosapi/topics", "rosapi/Topics").call(roslibpy.ServiceRequest())
    else:
        request = roslibpy.ServiceRequest(json.loads(message))
        service = roslibpy.Service(ros, name, "std_srvs/SetBool")
        print(json.dumps(dict(service.call(request, timeout=PROCESS_PATIENCE))))
    ros.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
