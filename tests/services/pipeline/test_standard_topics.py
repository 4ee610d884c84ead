"""Topics for robot tools: they follow a result, and never delay it or cost it.

result ──▶ ResultTopics ──/bm/frame, /BMresults──▶ FakeRosbridge
                    └─ later ─/bm/counts ... ────▶
"""

import asyncio
from contextlib import asynccontextmanager
from unittest.mock import Mock

import pytest

from services.boards.frames import decode_boards
from services.pipeline import standard_topics
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ResultTopics
from services.settings import Settings
from services.sockets.records import Begin, Notice, Outcome, Published
from services.sockets.status import BoardStatus, ProcessStatus, SilentProcess, StackStatus
from tests.fake_rosbridge import FakeRosbridge
from tests.services.conftest import until
from tests.services.pipeline.conftest import running
from tests.services.pipeline.test_publisher import REASON, publisher_of, result
from toolchain.deployment import TopicsSection

NAMES = ["/bm/counts", "/bm/decision", "/bm/posterior", "/bm/pose"]
OFF = dict.fromkeys(TopicsSection.model_fields, False)


@asynccontextmanager
async def topics_of(deployment, fake, **on):
    if on:
        deployment = deployment.model_copy(update={"topics": TopicsSection(**on)})
    topics = ResultTopics(Settings(uri=fake.uri), deployment)
    async with topics.opened():
        yield topics


def published(fake, *without):
    return [each["topic"] for each in fake.ops("publish") if each["topic"] not in without]


def values(status):
    return {pair["key"]: pair["value"] for pair in status["values"]}


async def test_every_topic_follows_the_result(boat):
    async with FakeRosbridge() as fake, topics_of(boat, fake) as topics:
        assert topics.publish_now(result(boat, 1)).outcome is Outcome.PUBLISHED
        await fake.wait_for_op("publish", topic="/diagnostics")
        order = published(fake)
        assert order[:2] == ["/bm/frame", "/BMresults"]
        assert order[2:] == [*NAMES, "/diagnostics"]
        grid, pose, counts, decision, health = (
            fake.ops("publish", topic=topic)[0]["msg"]
            for topic in ("/bm/posterior", "/bm/pose", "/bm/counts", "/bm/decision", "/diagnostics")
        )
        assert grid["data"] == [98] * 64
        assert [pose["pose"]["pose"]["position"][axis] for axis in "xy"] == pytest.approx([0, 0])
        assert (counts["data"], counts["layout"]["dim"][0]["size"]) == ([1] * 64, len(boat.boards))
        assert values(decision["status"][0])["number"] == "1"
        assert [each["name"] for each in health["status"]] == [f"rosbayes: board {at}" for at in range(4)]
        assert values(health["status"][2])["image"] == boat.boards[2].image_hash


@pytest.mark.parametrize("on", [*TopicsSection.model_fields])
async def test_each_is_switched_in_the_deployment(boat, on):
    async with FakeRosbridge() as fake:
        async with topics_of(boat, fake, **OFF | {on: True}) as topics:
            topics.publish_now(result(boat, 1))
        name, type_name = standard_topics._TYPES[on]
        await fake.wait_for_op("publish", topic=name)
        assert set(published(fake, "/bm/frame", "/BMresults")) == {name}
        (advertised,) = [each for each in fake.ops("advertise") if each["topic"] == name]
        assert advertised["type"].split("/")[::2] in ([*type_name.split("/")], [type_name.split("/")[0]])


async def test_of_frames_in_a_row_only_the_newest_follows(boat, monkeypatch):
    monkeypatch.setattr(standard_topics, "INTERVAL", 600.0)
    async with FakeRosbridge() as fake:
        async with topics_of(boat, fake) as topics:
            for number in (1, 2):
                topics.publish_now(result(boat, number))
            await fake.wait_for_op("publish", topic="/bm/decision")
            for number in (3, 4):  # their turn would be in ten minutes
                topics.publish_now(result(boat, number))
        # the end of the run
        await fake.wait_for_op("publish", topic="/bm/decision", count=2)
        decided = [each["msg"]["status"][0] for each in fake.ops("publish", topic="/bm/decision")]
        assert [values(each)["number"] for each in decided] == ["2", "4"]


async def test_a_slow_server_gets_them_when_it_takes_them(boat, monkeypatch):
    monkeypatch.setattr(standard_topics, "INTERVAL", 0.01)
    async with FakeRosbridge() as fake, topics_of(boat, fake) as topics:
        slow = Mock(must_wait=True, topic="/bm/counts")
        counts = topics.standard._publications["counts"]
        topics.standard._publications["counts"] = slow
        for number in (1, 2):
            assert topics.publish_now(result(boat, number)).outcome is Outcome.PUBLISHED
            first = topics.standard._timer
            await until(lambda first=first: topics.standard._timer is not first)
        await fake.wait_for_op("publish", topic="/BMresults", count=2)
        assert not set(NAMES) & set(published(fake))
        topics.standard._publications["counts"] = counts
        await fake.wait_for_op("publish", topic="/bm/decision")
        (decision,) = fake.ops("publish", topic="/bm/decision")
        assert values(decision["msg"]["status"][0])["number"] == "2"


async def test_a_fault_costs_a_warning_and_no_result(boat, monkeypatch, capfd):
    monkeypatch.setattr(standard_topics, "INTERVAL", 0.0)
    monkeypatch.setattr(standard_topics, "grid_message", Mock(side_effect=ZeroDivisionError("a bug")))
    async with FakeRosbridge() as fake, topics_of(boat, fake) as topics:
        for number in (1, 2, 3):
            assert topics.publish_now(result(boat, number)).outcome is Outcome.PUBLISHED
            await fake.wait_for_op("publish", topic="/bm/pose", count=number)
        assert "/bm/posterior" not in published(fake)
    assert capfd.readouterr().err.count("posterior = false under [topics]") == 1


async def test_a_type_that_the_server_lacks_is_one_warning(boat, link, monkeypatch):
    monkeypatch.setattr("services.pipeline.publisher.SETTLED_TIME", 0.0)
    monkeypatch.setattr("services.pipeline.publisher.CHECK_INTERVAL", 0.01)
    async with FakeRosbridge(rosapi=True) as fake:
        fake.refused_topics = {"/bm/posterior"}
        async with publisher_of(boat, link, fake.uri):
            await link.until(lambda: link.of(Notice))
            link.take(result(boat, 1))
            await fake.wait_for_op("publish", topic="/bm/pose")
            assert "/bm/posterior" not in published(fake)
            assert [each.outcome for each in link.of(Published)] == [Outcome.PUBLISHED]
            (notice,) = link.of(Notice)
            assert "posterior = false under [topics]" in notice.sentence


async def test_a_server_without_rosapi_may_report_a_refusal(boat, link):
    async with FakeRosbridge(statuses=True) as fake:
        fake.refused_topics = {"/bm/posterior"}
        async with publisher_of(boat, link, fake.uri):
            (notice,) = link.of(Notice)
            assert "posterior = false under [topics]" in notice.sentence
            link.take(result(boat, 1))
            await fake.wait_for_op("publish", topic="/bm/pose")
            assert "/bm/posterior" not in published(fake)


async def test_a_run_of_one_frame_publishes_them_before_it_ends(boat, link):
    async with FakeRosbridge() as fake, running(Publisher(Settings(uri=fake.uri), boat, link.make), link):
        link.take(Begin(once=True))
        link.take(result(boat, 1))
        await link.until(lambda: link.of(Published))
        assert link.of(Published)[0].seen
        await fake.wait_for_op("publish", topic="/bm/posterior")


async def test_a_frame_without_a_posterior_is_a_decision_that_is_not_valid(boat):
    async with FakeRosbridge() as fake, topics_of(boat, fake) as topics:
        topics.publish_now(result(boat, 1, count=0))
        await fake.wait_for_op("publish", topic="/diagnostics")
        assert not {"/bm/posterior", "/bm/pose"} & set(published(fake))
        (decision,) = fake.ops("publish", topic="/bm/decision")
        assert values(decision["msg"]["status"][0])["valid"] == "false"
        (health,) = fake.ops("publish", topic="/diagnostics")
        assert {each["level"] for each in health["msg"]["status"]} == {1}


async def test_cells_that_are_not_square_are_no_grid_but_a_pose(boat, capfd):
    rows, columns = boat.searched
    deployment = boat.model_copy(update={"searched": (rows, columns.replace(step=2 * columns.step))})
    async with FakeRosbridge() as fake, topics_of(deployment, fake) as topics:
        topics.publish_now(result(boat, 1))
        await fake.wait_for_op("publish", topic="/diagnostics")
        assert set(NAMES) - set(published(fake)) == {"/bm/posterior"}
    assert "/bm/posterior is not published: its cells would not be square" in capfd.readouterr().err


async def test_results_may_have_the_name_of_such_a_topic(boat, capfd):
    outputs = [boat.outputs[0].replace(topic="/bm/posterior")]
    async with FakeRosbridge() as fake:
        async with topics_of(boat.model_copy(update={"outputs": outputs}), fake) as topics:
            assert topics.publish_now(result(boat, 1)).outcome is Outcome.PUBLISHED
            await fake.wait_for_op("publish", topic="/diagnostics")
        (posterior,) = fake.ops("publish", topic="/bm/posterior")
        assert len(posterior["msg"]["data"]) == 64
        assert "/bm/pose" in published(fake)
    assert "/bm/posterior is not published for robot tools" in capfd.readouterr().err


async def test_the_health_is_that_of_boards_and_services(boat, monkeypatch, tmp_path):
    app = ProcessStatus(
        ready=False,
        why="board 1 is gone",
        name="pcie-app",
        boards=[
            BoardStatus(index=at, endpoint=f"unix:/b{at}", state=state, why=why, restarts=at)
            for at, state, why in ((0, "programmed", ""), (1, "gone", "board 1 is gone"))
        ],
    )
    stuck = ProcessStatus(ready=True, why="published", alive=False, name="publisher")
    fine = ProcessStatus(ready=True, why="programmed", name="board0")
    stack = StackStatus(
        directory="",
        ready=False,
        why=[],
        processes=[stuck, app, fine],
        silent=[SilentProcess("hub", "it is silent")],
    )

    async def ask(directory):
        assert directory == tmp_path
        return stack

    monkeypatch.setattr(standard_topics, "ask_stack", ask)
    async with FakeRosbridge() as fake:
        topics = ResultTopics(Settings(uri=fake.uri, run_directory=tmp_path), boat)
        async with topics.opened():
            reporting = asyncio.create_task(topics.standard.keep_reporting())
            await fake.wait_for_op("publish", topic="/diagnostics")
            (health,) = fake.ops("publish", topic="/diagnostics")
            reporting.cancel()
            await asyncio.wait([reporting])
            levels = {each["hardware_id"]: each["level"] for each in health["msg"]["status"]}
            assert levels == {
                **dict.fromkeys(["board0", "board2", "board3", "hub"], 3),
                **dict.fromkeys(["board1", "publisher"], 2),
                "pcie-app": 1,
            }
            assert values(health["msg"]["status"][1])["restarts"] == "1"
            # a change is reported with its frame
            topics.publish_now(result(boat, 1))
            await fake.wait_for_op("publish", topic="/diagnostics", count=2)
            changed = fake.ops("publish", topic="/diagnostics")[1]["msg"]["status"][0]
            assert (changed["level"], changed["message"]) == (0, boat.machine.kind.reasons[REASON])


async def test_a_silent_process_does_not_delay_the_next_health(boat, monkeypatch, tmp_path):
    asked = []

    async def ask(directory):
        asked.append(directory)
        return StackStatus(directory="", ready=False, why=[], processes=[], silent=[])

    monkeypatch.setattr(standard_topics, "ask_stack", ask)
    monkeypatch.setattr(standard_topics, "_HEALTH_INTERVAL", 600.0)
    async with FakeRosbridge() as fake:
        topics = ResultTopics(Settings(uri=fake.uri, run_directory=tmp_path), boat)
        async with topics.opened():
            reporting = asyncio.create_task(topics.standard.keep_reporting())
            # for the next message, while that one waits for its turn
            await until(lambda: len(asked) == 2)
            reporting.cancel()
            await asyncio.wait([reporting])
            assert len(fake.ops("publish", topic="/diagnostics")) <= 1


async def test_replicas_have_decisions_and_no_grid(boat):
    machine = boat.machine.replace(replicas=2)
    deployment = boat.model_copy(update={"machine": machine})
    publish = result(boat, 1)
    boards = decode_boards(publish.result)
    async with FakeRosbridge() as fake, topics_of(deployment, fake) as topics:
        topics.standard.offer(publish, Mock(boards=boards, posterior=None, details={}, outcome="none"))
        await fake.wait_for_op("publish", topic="/bm/decision")
        assert published(fake)[:2] == ["/bm/counts", "/bm/decision"]
        assert "/bm/posterior" not in {each["topic"] for each in fake.ops("advertise")}
