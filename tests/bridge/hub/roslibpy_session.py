"""What users of roslibpy do, all in one process, since its reactor starts only once. Prints what came of it.

Run as ``python roslibpy_session.py PORT``; ``ROSLIBPY_TRANSPORT`` chooses roslibpy's transport.
"""

import json
import queue
import sys
import threading
from typing import Any

import roslibpy

PATIENCE = 60


def _topics(ros: roslibpy.Ros, other: roslibpy.Ros) -> dict[str, Any]:
    heard: queue.Queue[Any] = queue.Queue()
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


def _latched(ros: roslibpy.Ros, other: roslibpy.Ros) -> Any:
    heard: queue.Queue[Any] = queue.Queue()
    roslibpy.Topic(ros, "/map", "nav_msgs/OccupancyGrid", latch=True).publish({"data": [1, 2, 3]})
    _wait_for(lambda: "/map" in ros.get_topics())
    roslibpy.Topic(other, "/map", "nav_msgs/OccupancyGrid").subscribe(heard.put)
    return heard.get(timeout=PATIENCE)


def _throttled(ros: roslibpy.Ros, other: roslibpy.Ros) -> Any:
    heard: queue.Queue[Any] = queue.Queue()
    topic = roslibpy.Topic(other, "/fast", "std_msgs/Int32", throttle_rate=1000, queue_length=1)
    topic.subscribe(heard.put)
    _wait_for(lambda: other.get_topic_type("/fast"))
    publisher = roslibpy.Topic(ros, "/fast", "std_msgs/Int32")
    for index in range(10):
        publisher.publish({"data": index})
    values = [heard.get(timeout=PATIENCE)["data"]]
    while values[-1] != 9:
        values.append(heard.get(timeout=PATIENCE)["data"])
    return values


def _header(ros: roslibpy.Ros, other: roslibpy.Ros) -> Any:
    heard: queue.Queue[Any] = queue.Queue()
    roslibpy.Topic(other, "/stamped", "std_msgs/Header").subscribe(heard.put)
    _wait_for(lambda: other.get_topic_type("/stamped"))
    header = roslibpy.Header(seq=7, stamp=roslibpy.Time(12, 34), frame_id="map")
    roslibpy.Topic(ros, "/stamped", "std_msgs/Header").publish(
        roslibpy.Message({"header": header, "x": float("nan")})
    )
    return heard.get(timeout=PATIENCE)


def _services(ros: roslibpy.Ros, other: roslibpy.Ros) -> dict[str, Any]:
    def add(request: Any, response: Any) -> bool:
        response["sum"] = request["a"] + request["b"]
        return bool(response["sum"] != 13)

    service = roslibpy.Service(ros, "/add", "rospy_tutorials/AddTwoInts")
    service.advertise(add)
    _wait_for(lambda: "/add" in other.get_services())
    caller = roslibpy.Service(other, "/add", "rospy_tutorials/AddTwoInts")
    answer = caller.call(roslibpy.ServiceRequest({"a": 1, "b": 2}), timeout=PATIENCE)
    called_back: queue.Queue[Any] = queue.Queue()
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


def _failure(service: roslibpy.Service, request: dict[str, Any]) -> str | None:
    try:
        service.call(roslibpy.ServiceRequest(request), timeout=PATIENCE)
    except roslibpy.core.ServiceException as error:
        return str(error)
    return None


def _parameters(ros: roslibpy.Ros, other: roslibpy.Ros) -> dict[str, Any]:
    ros.set_param("/robot/speed", {"max": 1.5})
    found = {"value": other.get_param("/robot/speed"), "names": other.get_params()}
    other.delete_param("/robot/speed")
    return found | {"deleted": ros.get_param("/robot/speed"), "names_after": ros.get_params()}


def _graph(ros: roslibpy.Ros, _other: roslibpy.Ros) -> dict[str, Any]:
    nodes: queue.Queue[Any] = queue.Queue()
    ros.get_nodes(nodes.put, nodes.put)
    details: queue.Queue[Any] = queue.Queue()
    ros.get_node_details("/rosapi", details.put, details.put)
    servers: queue.Queue[Any] = queue.Queue()
    ros.get_action_servers(servers.put, servers.put)
    return {
        "nodes": len(nodes.get(timeout=PATIENCE)["nodes"]),
        "rosapi_serves": len(details.get(timeout=PATIENCE)["services"]),
        "action_servers": dict(servers.get(timeout=PATIENCE)),
        "seconds": ros.get_time().secs,
    }


def _wait_for(condition: Any) -> None:
    pause = threading.Event()
    for _ in range(PATIENCE * 50):
        if condition():
            return
        pause.wait(0.02)
    raise TimeoutError(condition)


def main() -> None:
    """Do it all, print one JSON object."""
    ros, other = (roslibpy.Ros("127.0.0.1", int(sys.argv[1])) for _ in range(2))
    ros.run(PATIENCE)
    other.run(PATIENCE)
    ros.set_status_level("error", "level")  # the hub knows no such operation and stays well
    found = {
        step.__name__.strip("_"): step(ros, other)
        for step in (_topics, _latched, _throttled, _header, _services, _parameters, _graph)
    }
    print(json.dumps(found))
    sys.stdout.flush()
    ros.close()
    other.close()
    ros.terminate()


main()
