"""A robot with roslibpy, an independent client.

    python roslibpy_listener.py URI FILE COUNT [READING]

Publishes a reading, given as JSON, again and again. Writes one JSON line per message heard, and ends after COUNT
results; with a reading, also after a message on each of the topics for robot tools.
"""

import json
import sys
import threading
import time
from pathlib import Path

import roslibpy

TOPICS = {
    "/BMresults": "std_msgs/Float64MultiArray",
    "/bm/frame": "diagnostic_msgs/DiagnosticArray",
    "/boat/true_pose": "geometry_msgs/PoseStamped",
    "/boat/sensors": "boat_msgs/Sensors",
}


FOR_TOOLS = {
    "/bm/counts": "std_msgs/UInt32MultiArray",
    "/bm/posterior": "nav_msgs/OccupancyGrid",
    "/bm/pose": "geometry_msgs/PoseWithCovarianceStamped",
    "/bm/decision": "diagnostic_msgs/DiagnosticArray",
    "/diagnostics": "diagnostic_msgs/DiagnosticArray",
}
PATIENCE = 86_400.0
"""Seconds; a test that no longer waits for it kills it."""


def main(uri, file, count, reading=""):
    host, port = uri.removeprefix("ws://").rsplit(":", 1)
    ros = roslibpy.Ros(host=host, port=int(port))
    ros.run(timeout=PATIENCE)
    heard = []
    results = 0
    enough = threading.Event()

    def keep(topic):
        def take(msg):
            nonlocal results
            heard.append((topic, msg))
            results += topic == "/BMresults"
            if results >= count and awaited <= {topic for topic, _ in heard}:
                enough.set()

        return take

    awaited = set(FOR_TOOLS) if reading else set()
    topics = [
        roslibpy.Topic(ros, topic, type_)
        for topic, type_ in ((FOR_TOOLS if reading else {}) | TOPICS).items()
    ]
    for topic in topics:
        topic.subscribe(keep(topic.name))
    print("listening", file=sys.stderr, flush=True)
    sensors = topics[-1]
    while not enough.wait(0.05):
        if reading:
            sec, nanosec = divmod(time.time_ns(), 10**9)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "map"}
            sensors.publish(roslibpy.Message({"header": header, **json.loads(reading)}))
    ros.terminate()
    with Path(file).open("w") as out:
        for topic, msg in heard:
            out.write(json.dumps({"topic": topic, "msg": dict(msg)}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3]), *sys.argv[4:]))
