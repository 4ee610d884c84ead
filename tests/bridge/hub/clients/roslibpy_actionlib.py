"""The actionlib of roslibpy: a server that counts until it is cancelled, or a client of such a server.

Run as ``python roslibpy_actionlib.py server|client PORT``; the server runs until its input ends, and the client prints
JSON.
"""

import json
import sys
import threading

import roslibpy
from roslibpy.ros1.actionlib import ActionClient, Goal, SimpleActionServer

PATIENCE = 3600
"""The test that runs this has a limit of its own."""
TYPE = "actionlib_tutorials/FibonacciAction"


def serve(ros):
    """Serve `/count`; an order of 2 waits for cancellation."""
    server = SimpleActionServer(ros, "/count", TYPE)

    def execute(goal):
        order = goal["order"]
        server.send_feedback({"sequence": [0, 1]})
        if order != 2:
            server.set_succeeded({"sequence": list(range(order))})
            return
        pause = threading.Event()
        while not server.is_preempt_requested():
            pause.wait(0.02)
        server.set_preempted()

    server.start(execute)
    print("serving", flush=True)
    sys.stdin.read()


def send(ros):
    """Send goals to `/count`, and print their feedback and results."""
    client = ActionClient(ros, "/count", TYPE)
    finished = Goal(client, roslibpy.Message({"order": 5}))
    feedback = []
    finished.on("feedback", feedback.append)
    finished.send()
    result = finished.wait(PATIENCE)
    cancelled = Goal(client, roslibpy.Message({"order": 2}))
    started = threading.Event()
    cancelled.on("feedback", lambda _values: started.set())
    cancelled.send()
    assert started.wait(PATIENCE)
    cancelled.cancel()
    partial = cancelled.wait(PATIENCE)
    print(
        json.dumps(
            {
                "feedback": feedback,
                "result": result,
                "status": finished.status["status"],
                "cancelled": partial,
                "cancelled_status": cancelled.status["status"],
            }
        )
    )


def main():
    """Connect and play the part."""
    ros = roslibpy.Ros("127.0.0.1", int(sys.argv[2]))
    ros.run(PATIENCE)
    (serve if sys.argv[1] == "server" else send)(ros)
    ros.terminate()


if __name__ == "__main__":
    main()
