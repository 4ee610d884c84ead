"""Typical uses of roslibpy in one process, because its reactor starts only once; their results are printed.

Run as ``python roslibpy_session.py PORT``; ``ROSLIBPY_TRANSPORT`` chooses roslibpy's transport.
"""

import json
import queue
import sys
import threading

import roslibpy

PATIENCE = 3600
"""The test that runs this has a limit of its own."""


def _topics(ros, other):
    heard = queue.Queue()
    listener = roslibpy.Topic(other, "/chatter", "std_msgs/String")
    listener.subscribe(heard.put)
    _wait_for(lambda: other.get_topic_type("/chatter"))
    talker = roslibpy.Topic(ros, "/chatter", "std_msgs/msg/String")
    for index in range(5):
        talker.publish(roslibpy.Message({"data": f"hello {index}"}))
    messages = [heard.get(timeout=PATIENCE)["data"] for _ in range(5)]
    found = {
        "messages": messages,
        "topics": ros.get_topics(),
        "type": ros.get_topic_type("/chatter"),
        "for_type": ros.get_topics_for_type("std_msgs/msg/String"),
    }
    listener.unsubscribe()
    talker.unadvertise()
    _wait_for(lambda: "/chatter" not in ros.get_topics())
    return found


def _listen(ros, name, type_name):
    heard = queue.Queue()
    roslibpy.Topic(ros, name, type_name).subscribe(heard.put)
    _wait_for(lambda: ros.get_topic_type(name))
    return heard


def _header(ros, other):
    heard = _listen(other, "/stamped", "std_msgs/Header")
    header = roslibpy.Header(seq=7, stamp=roslibpy.Time(12, 34), frame_id="map")
    message = roslibpy.Message({"header": header, "x": float("nan")})
    roslibpy.Topic(ros, "/stamped", "std_msgs/Header", latch=True, throttle_rate=1).publish(message)
    return [heard.get(timeout=PATIENCE), _listen(other, "/stamped", "std_msgs/Header").get(timeout=PATIENCE)]


def _services(ros, other):
    def add(request, response):
        response["sum"] = request["a"] + request["b"]
        return bool(response["sum"] != 13)

    service = roslibpy.Service(ros, "/add", "rospy_tutorials/AddTwoInts")
    service.advertise(add)
    _wait_for(lambda: "/add" in other.get_services())
    caller = roslibpy.Service(other, "/add", "rospy_tutorials/AddTwoInts")
    answer = caller.call(roslibpy.ServiceRequest({"a": 1, "b": 2}), timeout=PATIENCE)
    called_back = queue.Queue()
    caller.call(roslibpy.ServiceRequest({"a": 3, "b": 4}), called_back.put, called_back.put)
    found = {
        "sum": answer["sum"],
        "called_back": called_back.get(timeout=PATIENCE)["sum"],
        "refused": _failure(caller, {"a": 6, "b": 7}),
        "type": other.get_service_type("/add"),
        "for_type": other.get_services_for_type("rospy_tutorials/AddTwoInts"),
        "nowhere": _failure(roslibpy.Service(other, "/nowhere", "a/B"), {}),
    }
    service.unadvertise()
    _wait_for(lambda: "/add" not in other.get_services())
    return found


def _failure(service, request):
    try:
        service.call(roslibpy.ServiceRequest(request), timeout=PATIENCE)
    except roslibpy.core.ServiceException as error:
        return str(error)
    return None


def _parameters(ros, other):
    ros.set_param("/robot/speed", {"max": 1.5})
    found = {"value": other.get_param("/robot/speed"), "names": other.get_params()}
    other.delete_param("/robot/speed")
    return found | {"deleted": ros.get_param("/robot/speed"), "names_after": ros.get_params()}


def _graph(ros, _other):
    def answer(ask, *args):
        answers = queue.Queue()
        ask(*args, answers.put, answers.put)
        return answers.get(timeout=PATIENCE)

    return {
        "nodes": len(answer(ros.get_nodes)["nodes"]),
        "rosapi_serves": len(answer(ros.get_node_details, "/rosapi")["services"]),
        "action_servers": dict(answer(ros.get_action_servers)),
        "seconds": ros.get_time().secs,
    }


def _wait_for(condition):
    pause = threading.Event()
    for _ in range(PATIENCE * 50):
        if condition():
            return
        pause.wait(0.02)
    raise TimeoutError(condition)


def main():
    """Do it all, print one JSON object."""
    ros, other = (roslibpy.Ros("127.0.0.1", int(sys.argv[1])) for _ in range(2))
    ros.run(PATIENCE)
    other.run(PATIENCE)
    ros.set_status_level("error", "level")  # the hub knows no such operation and stays well
    found = {
        step.__name__.strip("_"): step(ros, other)
        for step in (_topics, _header, _services, _parameters, _graph)
    }
    print(json.dumps(found))
    sys.stdout.flush()
    ros.close()
    other.close()
    ros.terminate()


main()
