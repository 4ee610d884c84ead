"""Messages with a known envelope are delivered and refused like those that are parsed whole."""

import json

import pytest

from tests.bridge.hub.broker_harness import publisher_and_subscriber

PUBLISH = b'{"op":"publish","topic":"/t","msg":'


def publisher_and_listener(**limits):
    """Connect a publisher of /t and /u whose envelope of /t the hub knows, and a listener to both."""
    publisher, listener = publisher_and_subscriber("p/T", limits=limits, queue_length=1000)
    publisher.advertise("/u", "p/T")
    listener.subscribe("/u", queue_length=1000)
    say(publisher, PUBLISH + b"{}}")
    assert publisher.client.last_published is not None
    assert listener.messages() == [{}]
    return publisher, listener


def say(publisher, data):
    """Send as a socket's transport does, which lets the hub use a known envelope."""
    hub = publisher.hub
    assert hub.broker.receive_turn(publisher.client, [data], hub.now) == 1
    hub.check()


def test_a_message_is_forwarded_unchanged():
    publisher, listener = publisher_and_listener()
    for message in (b'{"a": [1.50, 2e3], "b":"\\u00e9"}', b'{"a":1,"a":2}', b"{ }"):
        say(publisher, PUBLISH + message + b"}")
        assert listener.payloads() == [PUBLISH + message + b"}"]


@pytest.mark.parametrize(
    "rest",
    [
        b'{"a":1}}',
        b'{"a":1},"topic":"/u"}',
        b'{"a":1},"msg":{"b":2}}',
        b'{"a":1},"op":"unadvertise"}',
        b'{"a":[NaN,Infinity,1e999]}}',
        b'{"a":1}',
        b'{"a":1}]',
        b'{"a":1}} ',
        b'{"a":1}}}',
        b'{"a":"}}',
        b"[1]}",
        b"1}",
        b"null}",
        b"}",
        b"",
        b'{"a":"\xff"}}',
        b'{"a":"\\ud800"}}',
        b'{"a":[[[]]]}}',
        b'{"a":[[[[]]]]}}',
        b'{"a":"' + b"[" * 20 + b'"}}',
        b'{"a":"' + b"x" * 440 + b'"}}',
        b'{"a":"' + b"x" * 500 + b'"}}',
    ],
    ids=lambda rest: repr(rest[:40]),
)
def test_the_rest_of_an_operation_keeps_its_meaning(rest):
    (knowing, one), (reading, other) = (publisher_and_listener(depth=5, message_bytes=500) for _ in range(2))
    say(knowing, PUBLISH + rest)
    reading.send_raw(PUBLISH + rest)
    assert one.read() == other.read()
    assert knowing.client.refused == reading.client.refused


def test_a_topic_that_is_not_advertised_any_more_is_not_published():
    publisher, listener = publisher_and_listener()
    publisher.send(op="unadvertise", topic="/t")
    listener.send(op="unsubscribe", topic="/t")
    say(publisher, PUBLISH + b"{}}")
    assert publisher.client.refused == 1
    assert publisher.client.envelopes == {}


@pytest.mark.parametrize("begun", [b'{"op":"publish","msg":', b'{"msg":', b'{"topic":"/t","msg":'])
def test_an_operation_with_keys_after_its_message_has_no_envelope(begun):
    publisher, listener = publisher_and_listener()
    rest = {"op": "publish", "topic": "/t"}
    for key in [key for key in rest if f'"{key}"'.encode() in begun]:
        del rest[key]
    say(publisher, begun + b'{"n":1},' + json.dumps(rest).encode()[1:])
    assert listener.messages() == [{"n": 1}]
    say(publisher, begun + b'{"n":2}}')
    assert listener.messages() == []
    assert publisher.client.refused == 1


def test_each_topic_has_its_envelope_and_one_alone():
    publisher, listener = publisher_and_listener()
    said = [
        b'{"op":"publish","topic":"/%c","msg":{"n":%d}}' % (topic, n) for n in range(5) for topic in b"tu"
    ]
    for data in said:
        say(publisher, data)
    assert listener.payloads() == said
    for spaces in range(20):
        say(publisher, b'{%b"op":"publish","topic":"/t","msg":{}}' % (b" " * spaces))
    assert len(publisher.client.envelopes) == 2
