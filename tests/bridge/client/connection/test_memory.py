"""Memory of a long-running client stays flat: behind a slow reader, over reconnections, calls and broken messages."""

import gc
import json
import tracemalloc

import numpy as np
import pytest

from bridge.client import connect
from bridge.codecs import cbor_codec
from bridge.codecs.fragments import split
from tests.fake_rosbridge import FakeRosbridge

#: Bytes that may be more in use after many rounds than after few: caches, not one object a round.
SLACK = 40_000


def growth(play, rounds):
    """Bytes by which memory in use grew over the later rounds."""
    play(rounds // 4)
    gc.collect()
    tracemalloc.start()
    try:
        play(rounds // 4)
        gc.collect()
        before, _peak = tracemalloc.get_traced_memory()
        play(rounds)
        gc.collect()
        after, _peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return after - before


def encoded_as(msg, kind):
    operation = {"op": "publish", "topic": "/a", "msg": msg}
    if kind == "cbor":
        return [cbor_codec.encode(operation)]
    data = json.dumps(operation).encode()
    return list(split(data, 100, 1)) if kind == "fragments" else [data]


@pytest.mark.asyncio(loop_factories=["asyncio"])
@pytest.mark.parametrize("kind", ["json", "cbor", "fragments", "broken"])
async def test_a_reader_that_never_reads(kind):
    """The queue is full at once; each further message takes the place of the oldest."""
    compression = "cbor" if kind == "cbor" else "none"
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T", compression=compression, queue_size=8)
        values = np.arange(100.0)
        pieces = encoded_as({"data": values if kind == "cbor" else values.tolist()}, kind)
        if kind == "broken":
            pieces = [b"{", b"[1]", b"\xff\xfe", b'{"op":"fragment","id":1,"data":"x","num":0,"total":9}']
        take = ros._session._take

        def play(rounds):
            for number in range(rounds):
                for piece in pieces:
                    take([piece.replace(b'"id":1,', b'"id":%d,' % number) if kind == "broken" else piece])

        assert growth(play, 1200) < SLACK
        assert subscription.lost == (0 if kind == "broken" else 1800 - 8)
        assert ros.unusable >= (3 * 1800 if kind == "broken" else 0)


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_calls_and_goals_that_come_and_go(fake, ros):
    fake.serve("/echo", lambda args: args)
    take = ros._session._take

    def play(rounds):
        core = ros._session.core
        for number in range(rounds):
            call = core.calls.send("/echo", {"n": number})
            take([b'{"op":"service_response","id":"%b","values":{},"result":true}' % call.encode()])
            goal = core.goals.send("/fly", "p/Fly", {}, feedback=True)
            take([b'{"op":"action_result","id":"%b","values":{},"status":4}' % goal.encode()])
            core.subscriptions.unsubscribe(core.subscriptions.subscribe("/b", "p/T"))
            core.data_to_send()

    assert growth(play, 1500) < SLACK
