"""A listener with roslibpy, an independent client.

    python roslibpy_listener.py URI FILE COUNT

Writes one JSON line per message heard and ends after COUNT results, or 240 s.
"""

import json
import sys
import time
from pathlib import Path

import roslibpy

TOPICS = {
    "/BMresults": "std_msgs/Float64MultiArray",
    "/bm/frame": "diagnostic_msgs/DiagnosticArray",
    "/boat/true_pose": "geometry_msgs/PoseStamped",
    "/boat/sensors": "boat_msgs/Sensors",
}


def main(uri: str, file: str, count: int) -> int:
    host, port = uri.removeprefix("ws://").rsplit(":", 1)
    ros = roslibpy.Ros(host=host, port=int(port))
    ros.run(timeout=240)
    heard = []
    results = [0]

    def keep(topic: str):
        def take(msg) -> None:
            heard.append((topic, msg))
            results[0] += topic == "/BMresults"

        return take

    topics = [roslibpy.Topic(ros, topic, type_) for topic, type_ in TOPICS.items()]
    for topic in topics:
        topic.subscribe(keep(topic.name))
    print("listening", file=sys.stderr, flush=True)
    deadline = time.monotonic() + 240
    while results[0] < count and time.monotonic() < deadline:
        time.sleep(0.05)
    ros.terminate()
    with Path(file).open("w") as out:
        for topic, msg in heard:
            out.write(json.dumps({"topic": topic, "msg": dict(msg)}) + "\n")
    return 0 if results[0] >= count else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
