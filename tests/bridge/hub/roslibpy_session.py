"""Typical uses of roslibpy in one process, because its reactor starts only once: python roslibpy_session.py PORT."""

import queue
import sys
import threading
import time

import roslibpy

PATIENCE = 3600
"""The test that runs this has a limit of its own."""


def _wait_for(condition):
    while not condition():
        threading.Event().wait(0.02)


def _listen(ros, name, type_name):
    heard = queue.Queue()
    topic = roslibpy.Topic(ros, name, type_name)
    topic.subscribe(heard.put)
    _wait_for(lambda: ros.get_topic_type(name))
    return topic, heard


def _failure(service, request):
    try:
        service.call(roslibpy.ServiceRequest(request), timeout=PATIENCE)
    except roslibpy.core.ServiceException as error:
        return str(error)
    return None


def topics(ros, other):
    listener, heard = _listen(other, "/chatter", "std_msgs/String")
    talker = roslibpy.Topic(ros, "/chatter", "std_msgs/msg/String")
    for index in range(5):
        talker.publish(roslibpy.Message({"data": f"hello {index}"}))
    assert [heard.get(timeout=PATIENCE)["data"] for _ in range(5)] == [f"hello {index}" for index in range(5)]
    assert ros.get_topics() == ["/chatter", "/rosout"]
    assert ros.get_topics_for_type("std_msgs/msg/String") == ["/chatter"]
    listener.unsubscribe()
    talker.unadvertise()
    _wait_for(lambda: "/chatter" not in ros.get_topics())
    header = roslibpy.Header(seq=7, stamp=roslibpy.Time(12, 34), frame_id="map")
    latched = roslibpy.Topic(ros, "/stamped", "std_msgs/Header", latch=True, throttle_rate=1)
    latched.publish(roslibpy.Message({"header": header, "x": float("nan")}))
    message = _listen(other, "/stamped", "std_msgs/Header")[1].get(timeout=PATIENCE)
    assert message["header"] == {"seq": 7, "stamp": {"secs": 12, "nsecs": 34}, "frame_id": "map"}
    assert message["x"] is None


def services(ros, other):
    def add(request, response):
        response["sum"] = request["a"] + request["b"]
        return bool(response["sum"] != 13)

    service = roslibpy.Service(ros, "/add", "rospy_tutorials/AddTwoInts")
    service.advertise(add)
    _wait_for(lambda: "/add" in other.get_services())
    caller, called_back = roslibpy.Service(other, "/add", "rospy_tutorials/AddTwoInts"), queue.Queue()
    assert caller.call(roslibpy.ServiceRequest({"a": 1, "b": 2}), timeout=PATIENCE)["sum"] == 3
    caller.call(roslibpy.ServiceRequest({"a": 3, "b": 4}), called_back.put, called_back.put)
    assert called_back.get(timeout=PATIENCE)["sum"] == 7
    assert _failure(caller, {"a": 6, "b": 7}) is None  # as on the reference server of ROS 1
    nowhere = roslibpy.Service(other, "/nowhere", "a/B")
    assert _failure(nowhere, {}) == "Service /nowhere does not exist"
    assert other.get_service_type("/add") == "rospy_tutorials/AddTwoInts"
    service.unadvertise()
    _wait_for(lambda: "/add" not in other.get_services())


def parameters_and_graph(ros, other):
    ros.set_param("/robot/speed", {"max": 1.5})
    assert (other.get_param("/robot/speed"), other.get_params()) == ({"max": 1.5}, ["/robot/speed"])
    other.delete_param("/robot/speed")
    assert (ros.get_param("/robot/speed"), ros.get_params()) == (None, [])
    answers = queue.Queue()
    for ask in (ros.get_nodes, ros.get_action_servers):
        ask(answers.put, answers.put)
    found = dict(answers.get(timeout=PATIENCE)) | dict(answers.get(timeout=PATIENCE))
    assert (len(found["nodes"]), found["action_servers"]) == (3, [])
    assert abs(ros.get_time().secs - time.time()) < PATIENCE


def main():
    ros, other = (roslibpy.Ros("127.0.0.1", int(sys.argv[1])) for _ in range(2))
    ros.run(PATIENCE)
    other.run(PATIENCE)
    ros.set_status_level("error", "level")  # the hub knows no such operation, and serves on
    for step in (topics, services, parameters_and_graph):
        step(ros, other)
    ros.close()
    other.close()
    ros.terminate()


if __name__ == "__main__":
    main()
