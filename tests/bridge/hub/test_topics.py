import pytest

from tests.bridge.hub.broker_harness import Harness


def publish_numbers(publisher, count):
    messages = [{"i": index} for index in range(count)]
    for message in messages:
        publisher.publish("/t", message)
    return messages


def test_a_message_reaches_all_subscribers_and_nobody_else(hub, publisher, subscriber):
    typed, stranger = hub.connect(), hub.connect()
    typed.subscribe("/t", type="a/B")
    stranger.subscribe("/u")
    publisher.subscribe("/t")
    publisher.publish("/t", {"data": [1, 2.5, "x", None, True]})
    expected = {"op": "publish", "topic": "/t", "msg": {"data": [1, 2.5, "x", None, True]}}
    for peer in (subscriber, typed, publisher):
        assert peer.read() == [expected]
    assert stranger.read() == []


@pytest.mark.parametrize("compression", ["none", "png", "cbor", "cbor-raw"])
def test_each_form_is_encoded_once(hub, compression):
    publisher, *subscribers = (hub.connect() for _ in range(4))
    publisher.advertise("/t", "std_msgs/Float64MultiArray")
    for peer in subscribers:
        peer.subscribe("/t", compression=compression)
    subscribers[0].subscribe("/t", id="throttled", throttle_rate=1000)
    publisher.publish("/t", {"data": [1.5]})
    first, *others = (peer.client.outbox.pop() for peer in subscribers)
    assert first is not None
    assert all(other is first for other in others)


def test_names_with_and_without_slash_and_both_forms_of_a_type_are_one(hub, publisher, subscriber):
    other = hub.connect()
    other.subscribe("t", type="a/msg/B")
    other.advertise("t", "a/msg/B")
    for name in ("/t", "t"):
        publisher.publish(name, {"a": name})
    assert subscriber.messages("/t") == [{"a": "/t"}, {"a": "t"}]
    assert other.messages("t") == [{"a": "/t"}, {"a": "t"}]  # under the name that it used
    assert set(publisher.rosapi("publishers", topic="/t")["publishers"]) == {"/client_1", "/client_3"}


def test_another_type_is_refused_silently(hub, publisher):
    other = hub.connect()
    other.subscribe("/t", type="a/C")
    other.advertise("/t", "a/C")
    other.publish("/t", {"a": 0}, type="a/C")
    publisher.publish("/t", {"a": 1})
    assert other.read() == []
    assert other.client.refused == 3
    assert not other.client.advertisements


@pytest.mark.parametrize(
    ("name", "type_name"),
    [(name, "a/B") for name in ["", "/", "//t", "/t/", "/a b", "/ä", "/t" * 200, 7, None, ["/t"]]]
    + [("/t", type_name) for type_name in ["", "B", "a/b/c/D", "a/B ", 7]],
)
def test_malformed_names_and_types_are_refused(hub, name, type_name):
    peer = hub.connect()
    peer.send(op="advertise", topic=name, type=type_name)
    peer.send(op="subscribe", topic=name, type=type_name)
    peer.send(op="publish", topic=name, msg={}, type=type_name)
    assert peer.client.refused == 3
    assert not hub.broker.graph.topics


def test_publishing_advertises_where_the_type_is_known_or_given(hub):
    publisher, subscriber = hub.connect(), hub.connect()
    subscriber.subscribe("/known/0", type="a/B")
    subscriber.subscribe("/given")
    subscriber.subscribe("/unknown")
    publisher.publish("/known/0", {"a": 1})
    publisher.publish("/given", {"a": 2}, type="c/D")
    publisher.publish("/unknown", {"a": 3})
    assert subscriber.messages() == [{"a": 1}, {"a": 2}]
    assert subscriber.rosapi("topics") == {
        "topics": ["/known/0", "/given", "/unknown", "/rosout"],
        "types": ["a/B", "c/D", "", "rosgraph_msgs/Log"],
    }
    assert set(publisher.client.advertisements) == {"/known/0", "/given"}
    assert publisher.client.refused == 1


def test_a_subscriber_without_a_type_is_served_by_whoever_names_it(hub):
    untyped, first, second = hub.connect(), hub.connect(), hub.connect()
    untyped.subscribe("/t")
    for publisher, type_name in ((first, "a/B"), (second, "c/D")):
        publisher.advertise("/t", type_name)
        publisher.publish("/t", {"a": type_name})
        publisher.disconnect()
    assert untyped.messages() == [{"a": "a/B"}, {"a": "c/D"}]


@pytest.mark.parametrize("message", [1, "text", [1], None, True])
def test_only_an_object_is_a_message(publisher, subscriber, message):
    publisher.send(op="publish", topic="/t", msg=message)
    assert subscriber.read() == []
    publisher.send(op="publish", topic="/t")  # as on the reference server, an empty one
    assert subscriber.messages() == [{}]


# --- ids


def test_a_topic_is_advertised_until_each_of_its_ids_is_withdrawn(hub):
    peer = hub.connect()
    for withdrawn in (["unknown", "one", 2], [None]):  # without an id: all of them
        peer.advertise("/t", id="one")
        peer.advertise("/t", id=2)
        for each in withdrawn:
            assert "/t" in hub.broker.graph.topics
            peer.send(op="unadvertise", topic="/t", **({} if each is None else {"id": each}))
        assert not hub.broker.graph.topics


@pytest.mark.parametrize("last", [{}, {"id": "three"}])  # without an id: all of them, and what waits
def test_a_client_that_subscribes_twice_gets_each_message_once_until_it_unsubscribes_twice(
    hub, publisher, last
):
    subscriber = hub.connect()
    for each in ("two", "three"):
        subscriber.subscribe("/t", id=each)
    publisher.publish("/t", {"a": 1})
    assert subscriber.messages() == [{"a": 1}]
    if last:
        subscriber.send(op="unsubscribe", topic="/t", id="two")
    publisher.publish("/t", {"a": 2})
    assert subscriber.messages() == [{"a": 2}]
    publisher.publish("/t", {"a": 3})
    subscriber.send(op="unsubscribe", topic="/t", **last)
    publisher.publish("/t", {"a": 4})
    assert subscriber.messages() == []
    assert not subscriber.client.subscriptions


@pytest.mark.parametrize("identifier", [1.5, True, [], {}, "x" * 1025])
def test_an_id_is_a_string_or_an_integer(hub, identifier):
    peer = hub.connect()
    peer.subscribe("/t", id=identifier)
    peer.advertise("/t", id=identifier)
    assert peer.client.refused == 2
    assert not hub.broker.graph.topics


# --- latching


@pytest.mark.parametrize(
    ("advertised", "published"),
    [
        ({"latch": True}, {}),
        ({"qos": {"durability": "transient_local", "depth": 5}}, {}),
        (None, {"type": "a/B", "latch": True}),
    ],
)
def test_each_new_subscription_gets_the_latched_message_and_a_repeated_one_does_not(
    hub, advertised, published
):
    publisher, late, volatile = (hub.connect() for _ in range(3))
    if advertised is not None:
        publisher.advertise("/t", **advertised)
    publisher.publish("/t", {"i": 0}, **published)
    publisher.publish("/t", {"i": 1})
    late.subscribe("t", id="one")
    late.subscribe("t", id="two", compression="cbor", qos={"durability": "transient_local"})
    late.subscribe("t", id="two", compression="cbor")
    assert late.messages("t") == [{"i": 1}, {"i": 1}]
    volatile.subscribe("/t", qos={"durability": "volatile"})
    assert volatile.messages() == []


def test_a_latch_ends_with_its_publisher(hub):
    latching, other, late = (hub.connect() for _ in range(3))
    latching.advertise("/t", latch=True)
    latching.publish("/t", {"i": 0})
    other.advertise("/t")
    latching.disconnect()
    other.publish("/t", {"i": 5})
    late.subscribe("/t")
    assert late.messages() == []


def test_latched_messages_are_bounded_together():
    hub = Harness(latched_bytes=30)
    publisher, late = hub.connect(), hub.connect()
    for topic in ("/a", "/b"):
        publisher.advertise(topic, latch=True)
        publisher.publish(topic, {"data": "x" * 10})
    late.subscribe("/a")
    late.subscribe("/b")
    assert late.messages("/a") == [{"data": "x" * 10}]
    publisher.publish("/a", {})
    publisher.publish("/b", {"data": "y" * 10})
    late.read()
    late.subscribe("/b", id="again")
    assert late.messages("/b") == [{"data": "y" * 10}]


# --- throttle and queue


def test_a_throttle_is_kept_in_time(hub, publisher, subscriber):
    throttled = hub.connect()
    throttled.subscribe("/t", throttle_rate=100)
    received = []
    for index in range(10):
        publisher.publish("/t", {"i": index})
        received += throttled.messages()
        hub.advance(0.0301)
    assert received == [{"i": 0}, {"i": 4}, {"i": 8}]
    assert len(subscriber.messages()) == 10


def test_the_least_of_a_clients_options_applies(hub, publisher):
    subscriber = hub.connect()
    subscriber.subscribe("/t", id="slow", throttle_rate=1000, queue_length=5)
    publish_numbers(publisher, 2)
    assert subscriber.messages() == [{"i": 0}]
    subscriber.subscribe("/t", id="quick")
    assert subscriber.messages() == [{"i": 1}], "the throttled message is not lost"
    assert publish_numbers(publisher, 2) == subscriber.messages()
    subscriber.send(op="unsubscribe", topic="/t", id="quick")
    publish_numbers(publisher, 2)
    for expected in ({"i": 0}, {"i": 1}):
        hub.advance(1)
        assert subscriber.messages() == [expected]


@pytest.mark.parametrize("field", ["throttle_rate", "queue_length"])
def test_a_rate_or_a_length_that_is_not_a_number_refuses_the_subscription(hub, field):
    peer = hub.connect()
    for value in ("5", -1, True, [], 1e300):
        peer.subscribe("/t", **{field: value})
    assert peer.client.refused == 5
    assert not hub.broker.graph.topics
    peer.subscribe("/t", **{field: 0.0})
    assert "/t" in hub.broker.graph.topics


def test_a_slow_client_keeps_the_newest_and_costs_the_others_nothing():
    hub = Harness(queue_length=10, longest_queue=20)
    publisher, slow, latest, greedy, quick = (hub.connect() for _ in range(5))
    publisher.advertise("/t")
    slow.subscribe("/t")
    latest.subscribe("/t", queue_length=1)
    greedy.subscribe("/t", queue_length=10**9)
    quick.subscribe("/t")
    received = []
    for index in range(100):
        publisher.publish("/t", {"i": index})
        received += quick.messages()
    assert received == [{"i": index} for index in range(100)]
    for peer, kept in ((slow, 10), (latest, 1), (greedy, 20)):
        assert peer.messages() == received[-kept:]
    assert slow.client.subscriptions["/t"].lane.dropped == 90


@pytest.mark.parametrize(
    ("sent", "received"),
    [
        (b"[NaN,Infinity,-Infinity,1e999,-1e999,1.5]", [None, None, None, None, None, 1.5]),
        (b"[%d,%d]" % (10**30, 10**400), [1e30, None]),
        (b'1,"a":2', 2),
    ],
)
def test_unusual_json_is_made_strict(publisher, subscriber, sent, received):
    publisher.send_raw(b'{"op":"advertise","op":"publish","topic":"/t","msg":{"a":%b}}' % sent)
    assert subscriber.messages() == [{"a": received}]


def test_numbers_keep_their_values(publisher, subscriber):
    numbers = [0, -0.0, 1, -(2**63), 2**64 - 1, 0.1, 1e-320, 1.7976931348623157e308, 1e15]
    publisher.publish("/t", {"a": numbers})
    (message,) = subscriber.messages()
    assert [repr(number) for number in message["a"]] == [repr(number) for number in numbers]


@pytest.mark.parametrize(
    ("topic", "message", "spare"),
    [
        ("/t", b'{"a":"%b"}', 0),
        ("t", b'{"a":"%b"}', -1),  # a byte more under the longer name
        ("/t", b'{"n":[1e15],"a":"%b"}', -14),  # rewritten as 1000000000000000.0
    ],
)
def test_a_message_that_goes_out_larger_than_the_limit_is_refused(topic, message, spare):
    peer = Harness(message_bytes=500).connect()
    peer.advertise("t")
    peer.subscribe("/t")
    frame = b'{"op":"publish","topic":"%b","msg":%b}' % (topic.encode(), message)
    room = 500 - len(frame % b"") + spare
    for size, arrives in ((room + 1, False), (room, True)):
        peer.send_raw(frame % (b"x" * size))
        assert bool(peer.read()) is arrives
    assert peer.client.refused == 1


def test_topics_are_counted():
    hub = Harness(topics=3)
    one, other = hub.connect(), hub.connect()
    for index in range(5):
        one.subscribe(f"/t{index}")
    other.advertise("/u")
    other.advertise("/t0")
    assert list(hub.broker.graph.topics) == ["/t0", "/t1", "/t2"]
    assert (one.client.refused, other.client.refused) == (2, 1)
    one.disconnect()
    other.advertise("/u")
    assert list(hub.broker.graph.topics) == ["/t0", "/u"]


def test_open_operations_of_a_client_are_counted_by_id():
    hub = Harness(advertisements_per_client=2, subscriptions_per_client=2)
    peer = hub.connect()
    for index in range(4):
        peer.advertise("/t", id=index)
        peer.subscribe("/t", id=index)
    assert peer.client.refused == 4
    peer.advertise("/t", id=1)
    peer.subscribe("/t", id=1)
    assert peer.client.refused == 4, "what is open already can be repeated"
    peer.send(op="unsubscribe", topic="/t", id=0)
    peer.send(op="unadvertise", topic="/t", id=0)
    peer.subscribe("/u")
    peer.advertise("/u")
    assert peer.client.refused == 4
