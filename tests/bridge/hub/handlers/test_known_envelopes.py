"""A publisher whose envelope the hub knows is heard, and refused, as one whose messages are read whole."""

import json
from typing import Any

import orjson
import pytest

from bridge.hub.broker import Broker
from bridge.hub.graph import Client
from bridge.hub.limits import HubLimits

PUBLISH = b'{"op":"publish","topic":"/t","msg":'


class Hub:
    """A broker with a publisher of ``/t``, whose envelope is known or never is, and a listener to two topics."""

    def __init__(self, *, knowing: bool, **limits: Any) -> None:
        self.broker = Broker(HubLimits(**limits))
        self.knowing = knowing
        self.publisher, self.listener = self.broker.connect("a"), self.broker.connect("b")
        self.listener.outbox.wire = []
        for topic in ("/t", "/u"):
            self.ask(self.publisher, op="advertise", topic=topic, type="p/T")
            self.ask(self.listener, op="subscribe", topic=topic, queue_length=1000)
        self.say(PUBLISH + b"{}}")
        assert self.publisher.last_published is not None
        self.messages()

    def ask(self, client: Client, **operation: Any) -> None:
        self.broker.receive(client, json.dumps(operation).encode(), 0.0)

    def say(self, data: bytes) -> None:
        if self.knowing:
            assert self.broker.receive_turn(self.publisher, [data], 0.0) == 1
        else:
            self.broker.receive(self.publisher, data, 0.0)

    def messages(self) -> list[bytes]:
        assert self.listener.outbox.wire is not None
        wire, self.listener.outbox.wire = self.listener.outbox.wire, []
        return wire


def test_a_message_goes_on_as_it_came() -> None:
    hub = Hub(knowing=True)
    for message in (b'{"a": [1.50, 2e3], "b":"\\u00e9"}', b'{"a":1,"a":2}', b"{ }"):
        hub.say(PUBLISH + message + b"}")
        assert hub.messages() == [PUBLISH + message + b"}"]


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
def test_the_rest_of_an_operation_keeps_its_meaning(rest: bytes) -> None:
    knowing, reading = (Hub(knowing=known, depth=5, message_bytes=500) for known in (True, False))
    for hub in (knowing, reading):
        hub.say(PUBLISH + rest)
    assert list(map(orjson.loads, knowing.messages())) == list(map(orjson.loads, reading.messages()))
    assert knowing.publisher.refused == reading.publisher.refused


def test_a_topic_that_is_not_advertised_any_more_is_not_published() -> None:
    hub = Hub(knowing=True)
    hub.ask(hub.publisher, op="unadvertise", topic="/t")
    hub.ask(hub.listener, op="unsubscribe", topic="/t")
    hub.say(PUBLISH + b"{}}")
    assert hub.publisher.refused == 1
    assert hub.publisher.envelopes == {}


@pytest.mark.parametrize("begun", [b'{"op":"publish","msg":', b'{"msg":', b'{"topic":"/t","msg":'])
def test_an_operation_with_keys_after_its_message_has_no_envelope(begun: bytes) -> None:
    hub = Hub(knowing=True)
    rest = {"op": "publish", "topic": "/t"}
    for key in [key for key in rest if f'"{key}"'.encode() in begun]:
        del rest[key]
    hub.say(begun + b'{"n":1},' + json.dumps(rest).encode()[1:])
    assert [orjson.loads(payload)["msg"] for payload in hub.messages()] == [{"n": 1}]
    hub.say(begun + b'{"n":2}}')
    assert hub.messages() == []
    assert hub.publisher.refused == 1


def test_each_topic_has_its_envelope_and_one_alone() -> None:
    hub = Hub(knowing=True)
    said = [
        b'{"op":"publish","topic":"%b","msg":{"n":%d}}' % (topic, n)
        for n in range(5)
        for topic in (b"/t", b"/u")
    ]
    for data in said:
        hub.say(data)
    assert hub.messages() == said
    for spaces in range(20):
        hub.say(b'{%b"op":"publish","topic":"/t","msg":{}}' % (b" " * spaces))
    assert len(hub.publisher.envelopes) == 2
