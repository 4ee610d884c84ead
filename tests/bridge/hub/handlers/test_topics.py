import json

import pytest

from tests.bridge.hub.broker_harness import Room


def test_a_message_reaches_all_who_subscribed_and_nobody_else() -> None:
    room = Room()
    publisher, one, other, stranger = (room.enter() for _ in range(4))
    publisher.advertise("/t")
    one.subscribe("/t")
    other.subscribe("/t", type="a/B")
    stranger.subscribe("/u")
    publisher.publish("/t", {"data": [1, 2.5, "x", None, True]})
    assert one.read() == [{"op": "publish", "topic": "/t", "msg": {"data": [1, 2.5, "x", None, True]}}]
    assert len(other.heard("/t")) == 1
    assert stranger.read() == publisher.read() == []
    room.check()


def test_a_client_hears_itself() -> None:
    guest = Room().enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    guest.publish("/t", {"a": 1})
    assert guest.heard("/t") == [{"a": 1}]


def test_a_topic_is_the_same_without_its_slash_and_keeps_the_name_that_a_client_used() -> None:
    room = Room()
    publisher, one, other = room.enter(), room.enter(), room.enter()
    publisher.advertise("t")
    one.subscribe("/t")
    other.subscribe("t")
    publisher.publish("/t", {"a": 1})
    publisher.publish("t", {"a": 2})
    assert one.heard("/t") == other.heard("t") == [{"a": 1}, {"a": 2}]
    room.check()


@pytest.mark.parametrize("other", ["a/msg/B", "a/B"])
def test_both_forms_of_a_type_are_one(other: str) -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    publisher.advertise("/t", "a/B")
    subscriber.subscribe("/t", type=other)
    subscriber.advertise("/t", other)
    publisher.publish("/t", {"a": 1})
    assert subscriber.heard() == [{"a": 1}]
    assert set(publisher.rosapi("publishers", topic="/t")["publishers"]) == {"/client_1", "/client_2"}


def test_another_type_is_refused_without_a_word() -> None:
    room = Room()
    publisher, other = room.enter(), room.enter()
    publisher.advertise("/t", "a/B")
    other.subscribe("/t", type="a/C")
    other.advertise("/t", "a/C")
    other.publish("/t", {"a": 0}, type="a/C")
    publisher.publish("/t", {"a": 1})
    assert other.read() == []
    assert other.client.refused == 3
    assert not other.client.advertisements
    room.check()


@pytest.mark.parametrize("name", ["", "/", "//t", "/t/", "/a b", "/ä", "/t" * 200, 7, None, ["/t"]])
def test_what_is_no_name_is_refused(name: object) -> None:
    room = Room()
    guest = room.enter()
    guest.send(op="advertise", topic=name, type="a/B")
    guest.send(op="subscribe", topic=name)
    guest.send(op="publish", topic=name, msg={}, type="a/B")
    assert guest.client.refused == 3
    assert not room.broker.graph.topics


def test_a_part_of_a_name_may_be_a_number() -> None:
    guest = Room().enter()
    guest.advertise("/camera/0")
    guest.subscribe("/camera/0")
    guest.publish("/camera/0", {"a": 1})
    assert guest.heard("/camera/0") == [{"a": 1}]


@pytest.mark.parametrize("type_name", ["", "B", "a/b/c/D", "a/B ", 7])
def test_what_is_no_type_is_refused(type_name: object) -> None:
    room = Room()
    guest = room.enter()
    guest.send(op="advertise", topic="/t", type=type_name)
    guest.send(op="subscribe", topic="/t", type=type_name)
    guest.send(op="publish", topic="/t", msg={}, type=type_name)
    assert guest.client.refused == 3
    assert not room.broker.graph.topics


# --- publishing without advertising


def test_publishing_on_a_topic_of_unknown_type_goes_nowhere() -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    subscriber.subscribe("/t")
    publisher.publish("/t", {"a": 1})
    assert subscriber.read() == []
    assert publisher.client.refused == 1
    room.check()


def test_publishing_advertises_where_the_type_is_known_or_said() -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    subscriber.subscribe("/known", type="a/B")
    subscriber.subscribe("/said")
    publisher.publish("/known", {"a": 1})
    publisher.publish("/said", {"a": 2}, type="c/D")
    assert subscriber.heard() == [{"a": 1}, {"a": 2}]
    assert subscriber.rosapi("topics") == {
        "topics": ["/known", "/said", "/rosout"],
        "types": ["a/B", "c/D", "rosgraph_msgs/Log"],
    }
    assert set(publisher.client.advertisements) == {"/known", "/said"}
    room.check()


def test_a_subscriber_who_comes_first_and_knows_no_type_is_served_later() -> None:
    room = Room()
    subscriber, publisher = room.enter(), room.enter()
    subscriber.subscribe("/t")
    publisher.advertise("/t", "a/B")
    publisher.publish("/t", {"a": 1})
    assert subscriber.heard() == [{"a": 1}]


def test_the_type_of_a_topic_goes_with_those_who_named_it() -> None:
    room = Room()
    untyped, first, second = room.enter(), room.enter(), room.enter()
    untyped.subscribe("/t")
    first.advertise("/t", "a/B")
    first.leave()
    second.advertise("/t", "c/D")
    second.publish("/t", {"a": 1})
    assert untyped.heard() == [{"a": 1}]
    room.check()


@pytest.mark.parametrize("message", [1, "text", [1], None, True])
def test_only_an_object_is_a_message(message: object) -> None:
    room = Room()
    guest = room.enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    guest.send(op="publish", topic="/t", msg=message)
    assert guest.read() == []
    guest.send(op="publish", topic="/t")  # as on the reference server, an empty one
    assert guest.heard() == [{}]


# --- ids


def test_a_topic_is_advertised_until_each_of_its_ids_is_not() -> None:
    room = Room()
    guest = room.enter()
    guest.advertise("/t", id="one")
    guest.advertise("/t", id=2)
    guest.send(op="unadvertise", topic="/t", id="unknown")
    guest.send(op="unadvertise", topic="/t", id="one")
    room.check()
    assert "/t" in room.broker.graph.topics
    guest.send(op="unadvertise", topic="/t", id=2)
    assert not room.broker.graph.topics
    guest.advertise("/t", id="one")
    guest.advertise("/t", id=2)
    guest.send(op="unadvertise", topic="/t")  # without an id: all of them
    assert not room.broker.graph.topics
    room.check()


def test_a_client_that_subscribes_twice_hears_once_until_it_left_twice() -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    publisher.advertise("/t")
    subscriber.subscribe("/t", id="one")
    subscriber.subscribe("/t", id="two")
    publisher.publish("/t", {"a": 1})
    assert subscriber.heard() == [{"a": 1}]
    subscriber.send(op="unsubscribe", topic="/t", id="one")
    publisher.publish("/t", {"a": 2})
    assert subscriber.heard() == [{"a": 2}]
    room.check()
    subscriber.send(op="unsubscribe", topic="/t", id="two")
    publisher.publish("/t", {"a": 3})
    assert subscriber.heard() == []
    room.check()


def test_unsubscribing_without_an_id_ends_all_and_what_waits() -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    publisher.advertise("/t")
    subscriber.subscribe("/t")
    subscriber.subscribe("/t", id="two")
    publisher.publish("/t", {"a": 1})
    subscriber.send(op="unsubscribe", topic="/t")
    publisher.publish("/t", {"a": 2})
    assert subscriber.heard() == []
    room.check()


@pytest.mark.parametrize("identifier", [1.5, True, [], {}, "x" * 1025])
def test_an_id_is_a_string_or_an_integer(identifier: object) -> None:
    room = Room()
    guest = room.enter()
    guest.subscribe("/t", id=identifier)
    guest.advertise("/t", id=identifier)
    assert guest.client.refused == 2
    assert not room.broker.graph.topics


# --- latching


def test_a_latched_message_greets_who_comes_later() -> None:
    room = Room()
    publisher, early, late = room.enter(), room.enter(), room.enter()
    early.subscribe("/t")
    publisher.advertise("/t", latch=True)
    publisher.publish("/t", {"a": 1})
    publisher.publish("/t", {"a": 2})
    late.subscribe("t")
    assert early.heard() == [{"a": 1}, {"a": 2}]
    assert late.heard("t") == [{"a": 2}]
    room.check()


def test_without_a_latch_nothing_greets() -> None:
    room = Room()
    publisher, late = room.enter(), room.enter()
    publisher.advertise("/t")
    publisher.publish("/t", {"a": 1})
    late.subscribe("/t")
    assert late.heard() == []


def test_a_latch_ends_with_its_publisher() -> None:
    room = Room()
    publisher, other, late = room.enter(), room.enter(), room.enter()
    publisher.advertise("/t", latch=True)
    other.advertise("/t")
    publisher.publish("/t", {"a": 1})
    publisher.leave()
    late.subscribe("/t")
    assert late.heard() == []
    room.check()


def test_publishing_with_latch_latches() -> None:
    room = Room()
    publisher, late = room.enter(), room.enter()
    publisher.publish("/t", {"a": 1}, type="a/B", latch=True)
    late.subscribe("/t")
    assert late.heard() == [{"a": 1}]


def test_each_new_subscription_of_a_client_is_greeted_and_a_repeated_one_is_not() -> None:
    room = Room()
    publisher, late = room.enter(), room.enter()
    publisher.advertise("/t", latch=True)
    publisher.publish("/t", {"a": 1})
    late.subscribe("/t", id="one")
    late.subscribe("/t", id="two")
    late.subscribe("/t", id="two")
    assert late.heard() == [{"a": 1}, {"a": 1}]


def test_latched_messages_are_bounded_together() -> None:
    room = Room(latched_bytes=30)
    publisher, late = room.enter(), room.enter()
    for topic in ("/a", "/b"):
        publisher.advertise(topic, latch=True)
        publisher.publish(topic, {"data": "x" * 10})
        room.check()
    late.subscribe("/a")
    late.subscribe("/b")
    assert late.heard("/a") == [{"data": "x" * 10}]
    publisher.publish("/a", {})
    publisher.publish("/b", {"data": "y" * 10})
    late.read()
    late.subscribe("/b", id="again")
    assert late.heard("/b") == [{"data": "y" * 10}]
    room.check()


# --- throttle and queue


def test_a_throttle_is_kept_in_time() -> None:
    room = Room()
    publisher, throttled, free = room.enter(), room.enter(), room.enter()
    publisher.advertise("/t")
    throttled.subscribe("/t", throttle_rate=100)
    free.subscribe("/t")
    heard = []
    for index in range(10):
        publisher.publish("/t", {"i": index})
        heard += throttled.heard()
        room.pass_time(0.0301)
    assert heard == [{"i": 0}, {"i": 4}, {"i": 8}]
    assert len(free.heard()) == 10
    room.check()


def test_a_throttle_with_a_queue_delivers_later_what_it_held() -> None:
    room = Room()
    publisher, throttled = room.enter(), room.enter()
    publisher.advertise("/t")
    throttled.subscribe("/t", throttle_rate=100, queue_length=2)
    for index in range(5):
        publisher.publish("/t", {"i": index})
    heard = []
    for _ in range(4):
        heard.append(throttled.heard())
        room.check()
        room.pass_time(0.1)
    assert heard == [[{"i": 0}], [{"i": 3}], [{"i": 4}], []]


def test_the_least_of_a_clients_wishes_counts() -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    publisher.advertise("/t")
    subscriber.subscribe("/t", id="slow", throttle_rate=1000, queue_length=5)
    publisher.publish("/t", {"i": 0})
    publisher.publish("/t", {"i": 1})
    assert subscriber.heard() == [{"i": 0}]
    subscriber.subscribe("/t", id="quick")
    assert subscriber.heard() == [{"i": 1}], "what the throttle held is not lost"
    publisher.publish("/t", {"i": 2})
    publisher.publish("/t", {"i": 3})
    assert subscriber.heard() == [{"i": 2}, {"i": 3}]
    subscriber.send(op="unsubscribe", topic="/t", id="quick")
    publisher.publish("/t", {"i": 4})
    publisher.publish("/t", {"i": 5})
    room.pass_time(1)
    assert subscriber.heard() == [{"i": 4}]
    room.pass_time(1)
    assert subscriber.heard() == [{"i": 5}]
    room.check()


def test_a_throttle_that_is_lowered_wakes_earlier() -> None:
    room = Room()
    publisher, subscriber = room.enter(), room.enter()
    publisher.advertise("/t")
    subscriber.subscribe("/t", throttle_rate=10_000, queue_length=5)
    publisher.publish("/t", {"i": 0})
    publisher.publish("/t", {"i": 1})
    assert len(subscriber.heard()) == 1
    subscriber.subscribe("/t", throttle_rate=100, queue_length=5)
    room.check()
    room.pass_time(0.1)
    assert subscriber.heard() == [{"i": 1}]


@pytest.mark.parametrize("field", ["throttle_rate", "queue_length"])
def test_a_rate_or_a_length_that_is_no_number_refuses_the_subscription(field: str) -> None:
    room = Room()
    guest = room.enter()
    for value in ("5", -1, True, [], 1e300):
        guest.subscribe("/t", **{field: value})
    assert guest.client.refused == 5
    assert not room.broker.graph.topics
    guest.subscribe("/t", **{field: 0.0})
    assert "/t" in room.broker.graph.topics


def test_a_slow_client_keeps_the_newest_and_costs_the_others_nothing() -> None:
    room = Room(queue_length=10)
    publisher, slow, latest, quick = (room.enter() for _ in range(4))
    publisher.advertise("/t")
    slow.subscribe("/t")
    latest.subscribe("/t", queue_length=1)
    quick.subscribe("/t")
    heard = []
    for index in range(100):
        publisher.publish("/t", {"i": index})
        heard += quick.heard()
        room.check()
    assert heard == [{"i": index} for index in range(100)]
    assert slow.heard() == [{"i": index} for index in range(90, 100)]
    assert latest.heard() == [{"i": 99}]
    assert slow.client.subscriptions["/t"].lane.dropped == 90


def test_a_client_cannot_ask_for_a_queue_without_end() -> None:
    room = Room(longest_queue=5)
    publisher, slow = room.enter(), room.enter()
    publisher.advertise("/t")
    slow.subscribe("/t", queue_length=10**9)
    for index in range(100):
        publisher.publish("/t", {"i": index})
    assert len(slow.heard()) == 5


def test_subscribers_by_one_name_share_one_payload() -> None:
    room = Room()
    publisher, one, other = room.enter(), room.enter(), room.enter()
    publisher.advertise("/t")
    one.subscribe("/t")
    other.subscribe("/t")
    publisher.publish("/t", {"a": 1})
    assert one.client.outbox.pop() is other.client.outbox.pop()


# --- numbers, sizes


def test_nan_and_infinities_come_out_as_null() -> None:
    guest = Room().enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    guest.send_raw(b'{"op":"publish","topic":"/t","msg":{"a":[NaN,Infinity,-Infinity,1e999,-1e999,1.5]}}')
    assert guest.heard() == [{"a": [None, None, None, None, None, 1.5]}]
    guest.send_raw(b'{"op":"publish","topic":"/t","msg":{"a":[%d,%d]}}' % (10**30, 10**400))
    assert guest.heard() == [{"a": [1e30, None]}]


def test_numbers_keep_their_values() -> None:
    guest = Room().enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    numbers = [0, -0.0, 1, -(2**63), 2**64 - 1, 0.1, 1e-320, 1.7976931348623157e308, 1e15]
    guest.publish("/t", {"a": numbers})
    (message,) = guest.heard()
    assert [repr(number) for number in message["a"]] == [repr(number) for number in numbers]


def test_of_two_equal_keys_the_last_counts() -> None:
    guest = Room().enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    guest.send_raw(b'{"op":"advertise","op":"publish","topic":"/t","msg":{"a":1,"a":2}}')
    assert guest.heard() == [{"a": 2}]


def test_a_message_that_grows_beyond_the_limit_is_refused() -> None:
    room = Room(message_bytes=1000)
    guest = room.enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    guest.send_raw(b'{"op":"publish","topic":"/t","msg":{"b":"\\n","a":[%b]}}' % b",".join([b"1e15"] * 150))
    assert guest.read() == []
    assert guest.client.refused == 1
    guest.send_raw(b'{"op":"publish","topic":"/t","msg":{"a":[%b]}}' % b",".join([b"1e15"] * 40))
    assert len(guest.heard()) == 1


def test_a_message_of_exactly_the_limit_passes_to_whoever_uses_the_longer_name() -> None:
    room = Room(message_bytes=500)
    guest = room.enter()
    guest.advertise("t")
    guest.subscribe("/t")
    frame = json.dumps({"op": "publish", "topic": "/t", "msg": {"a": ""}}, separators=(",", ":"))
    fill = "x" * (500 - len(frame))
    guest.send_raw(frame.replace('""', f'"{fill}"').encode())
    assert guest.heard() == [{"a": fill}]
    guest.send_raw(frame.replace('"/t"', '"t"').replace('""', f'"{fill}x"').encode())
    assert guest.read() == []  # would be one byte more under the longer name
    assert guest.client.refused == 1


# --- limits


def test_topics_are_counted() -> None:
    room = Room(topics=3)
    one, other = room.enter(), room.enter()
    for index in range(5):
        one.subscribe(f"/t{index}")
    other.advertise("/u")
    other.advertise("/t0")
    assert list(room.broker.graph.topics) == ["/t0", "/t1", "/t2"]
    assert (one.client.refused, other.client.refused) == (2, 1)
    one.leave()
    other.advertise("/u")
    assert list(room.broker.graph.topics) == ["/t0", "/u"]
    room.check()


def test_open_operations_of_a_client_are_counted_by_id() -> None:
    room = Room(advertisements_per_client=2, subscriptions_per_client=2)
    guest = room.enter()
    for index in range(4):
        guest.advertise("/t", id=index)
        guest.subscribe("/t", id=index)
    assert guest.client.refused == 4
    guest.advertise("/t", id=1)
    guest.subscribe("/t", id=1)
    assert guest.client.refused == 4, "what is open already can be repeated"
    guest.send(op="unsubscribe", topic="/t", id=0)
    guest.send(op="unadvertise", topic="/t", id=0)
    guest.subscribe("/u")
    guest.advertise("/u")
    assert guest.client.refused == 4
    room.check()


def test_the_hub_says_when_it_is_full() -> None:
    room = Room(clients=2)
    guest = room.enter()
    assert not room.broker.full
    room.enter()
    assert room.broker.full
    guest.leave()
    assert not room.broker.full
