"""The sentence of `scripts/bench bridge` about messages that the hub dropped."""

from collections import defaultdict

from scripts.benches import bridge as bench
from scripts.benches.bare import bare, publish
from tests.bridge.hub.sockets import running_hub


class Child:
    """A client under measurement that publishes fewer messages than it should, as if the hub had dropped some."""

    name = bench.OURS

    def __init__(self, publisher):
        self.publisher = publisher

    def send(self, *, do, topic, values, count):
        self.publisher.send(publish(topic, [0.5] * values) * (count - 3) + publish(topic, [-1.0]))

    async def answer(self):
        return {"cpu_s": 0.5}


async def test_dropped_messages_are_counted():
    async with running_hub() as port, bare(f"ws://127.0.0.1:{port}") as publisher:
        measured = bench.published(Child(publisher), f"ws://127.0.0.1:{port}", "/t", bench.LARGE, 10)
        rate, cpu, dropped = await measured
    assert rate > 0
    assert (cpu, dropped) == (50_000, 3)


def test_drops_are_printed_and_only_drops(capsys):
    found = defaultdict(lambda: defaultdict(lambda: [1.0]))
    servers = {"hub": [2.0], "Tornado double": [1.0]}
    bench.show(servers, found, defaultdict(int, {(bench.OURS, 6): 0, (bench.THEIRS[0], 1024): 7}))
    lines = [line for line in capsys.readouterr().out.splitlines() if "dropped" in line]
    assert len(lines) == 1
    assert lines[0].startswith(
        "The hub dropped 7 of 3,003 messages of 1024 values that roslibpy, twisted published,"
    )
