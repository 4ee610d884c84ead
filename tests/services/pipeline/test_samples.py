"""A machine that samples, from a message to the topics of results, reports and samples, and through a pipe.

message ──▶ FrameAssembler ──▶ DeployedBoards ──▶ boards in threads ──▶ ResultTopics ──▶ FakeRosbridge
"""

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from machines.bm2_kind import BM2
from machines.errors import MachineError
from machines.kind import FrameInput
from posteriors import posterior
from posteriors.axes import Axis
from posteriors.frame_report import read_frame_report
from posteriors.pairing import Pairing
from posteriors.posterior import read_posterior, read_samples
from services.boards.deployed import images_of
from services.boards.frames import decode_boards, result_record
from services.errors import InputLineError
from services.output.posterior_file import record
from services.output.posterior_output import line
from services.pipeline.frames import FrameAssembler
from services.pipeline.result_topics import ResultTopics
from services.pipes.pcie_app import compute_lines
from services.pipes.publisher import result_from_line
from services.settings import Settings
from services.sockets.records import FrameRequest, Outcome, Publish
from tests.fake_rosbridge import FakeRosbridge
from tests.services.pipeline.test_boards_to_topics import opened
from tests.toolchain.running import OPTIONS
from toolchain.building.bm2_machine import plan_bm2
from toolchain.building.build import build_deployment
from toolchain.deployment import load_deployment
from toolchain.models import JointDistribution, LabelType, Symbol, table

SAMPLES = 500


def built(folder, **options):
    rain, sprinkler = (Symbol(name, LabelType("no", "yes")) for name in ("Rain", "Sprinkler"))
    grass = Symbol("Grass", LabelType("dry", "wet", "white"), path="grass", on_missing="missing")
    of_grass = np.zeros((3, 2, 2))
    of_grass[1] = [[0, 0.8], [0.9, 0.99]]
    of_grass[0] = 1 - of_grass[1]  # it is never white
    joint = JointDistribution(
        "lawn",
        (
            table(rain, [0.8, 0.2]),
            table(sprinkler, [[0.6, 0.99], [0.4, 0.01]], given=[rain]),
            table(grass, of_grass, given=[sprinkler, rain]),
        ),
    )
    network = joint.ask([rain], [grass]).network()
    options = {"target_count": SAMPLES, "burn_in": 20, "partitions": 2} | options
    build_deployment(plan_bm2(network, replace(OPTIONS, **options)), folder / "built")
    return load_deployment(folder / "built")


@pytest.fixture
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("b")


async def published(folder, deployment, message):
    """Publish the result of one message; return the record for the master, and topics and messages as published."""
    async with FakeRosbridge() as fake:
        topics = ResultTopics(Settings(uri=fake.uri), deployment)
        with opened(folder, deployment) as boards:
            boards.open()
            async with topics.opened():
                (reading,) = FrameAssembler(deployment).take(0, message, 5, 6)
                output = boards.run(FrameRequest(1, reading.addresses, 1))
                heard = topics.publish_now(Publish(result_record(1, output), 0, 0, 0, 0, 0))
                await fake.wait_for_op("publish", topic="/bm/frame")
                if heard.outcome is Outcome.PUBLISHED:
                    await fake.wait_for_op("publish", topic="/BMresults")
                published = [(each["topic"], each["msg"]) for each in fake.ops("publish")]
    return heard, [each for each in published if each[0] in {"/bm/frame", "/bm/samples", "/BMresults"}]


async def test_posterior_details_and_samples_are_published(folder):
    deployment = built(folder, stream=64)
    heard, messages = await published(folder, deployment, {"grass": "wet"})
    assert (heard.outcome, heard.why) == (Outcome.PUBLISHED, "")
    assert [topic for topic, _ in messages] == ["/bm/frame", "/bm/samples", "/BMresults"]
    report, samples, result = (message for _, message in messages)
    machines = [image.machine for image in images_of(deployment)]
    frame = FrameInput(addresses=(1,), target_count=SAMPLES, max_cycles=2**32, bank=1)
    found = read_posterior(result, 0)
    assert found.probabilities == tuple(BM2.posterior(machines, frame)[0].tolist())
    here = posterior(folder / "built", {"Grass": "wet"}, bank=1)
    assert found.probabilities == here.probabilities
    assert found.labels == ("Rain",)
    details = read_frame_report(report, 0).details
    assert details["samples"] == str(2 * SAMPLES)
    assert {"unused", "effective_samples", "standard_error", "r_hat"} <= set(details)
    pairing = Pairing()
    pairing.add_report(read_frame_report(report, 0))
    (heard_of,) = pairing.add_posterior(found)
    for each in (heard_of, here):
        assert {"samples", "effective_samples", "standard_error", "r_hat"} <= set(each.details)
        assert record(each, [Axis("Rain", 2)])["details"] == each.details
    assert [each["size"] for each in samples["layout"]["dim"]] == [2 * SAMPLES, 4]
    assert [each.label for each in deployment.state_dimensions] == ["Rain", "Sprinkler", "Grass"]
    assert [each.states[-1] for each in deployment.state_dimensions] == ["yes", "yes", "white"]
    values = read_samples(samples, [each.size for each in deployment.state_dimensions])
    assert (values[:, 2] == 1).all()
    assert found.probabilities[1] == values[:, 0].mean()
    assert set(values[:, 1]) == {0, 1}


async def test_without_a_stream_there_is_no_topic_of_samples(folder):
    heard, messages = await published(folder, built(folder), {"grass": None})
    assert (heard.outcome, heard.why) == (Outcome.PUBLISHED, "")
    assert [topic for topic, _ in messages] == ["/bm/frame", "/BMresults"]


@pytest.mark.parametrize("stream", [0, 64])
async def test_impossible_readings_have_a_report_alone(folder, stream):
    heard, messages = await published(folder, built(folder, stream=stream), {"grass": "white"})
    assert heard.outcome is Outcome.NO_POSTERIOR
    ((topic, message),) = messages
    report = read_frame_report(message, 0)
    assert (topic, report.published) == ("/bm/frame", False)
    assert "impossible" in report.outcome
    assert heard.why == report.outcome
    assert {board.stopped for board in report.boards} == {"impossible"} == {heard.cause}


async def test_a_time_out_names_board_and_variable(folder):
    heard, messages = await published(folder, built(folder, ops_timeout=1), {"grass": "wet"})
    assert heard.outcome is Outcome.NO_POSTERIOR
    report = read_frame_report(messages[0][1], 0)
    assert "board0" in report.outcome
    assert heard.why == report.outcome
    assert any(name in report.outcome for name in ("Rain", "Sprinkler"))
    assert {board.stopped for board in report.boards} == {"ops time-out"}


async def test_a_biased_result_is_marked_as_doubtful_wherever_it_is_shown(folder):
    heard, ((_, message), (_, result)) = await published(
        folder, built(folder, max_cycles=900), {"grass": "wet"}
    )
    report = read_frame_report(message, 0)
    assert (heard.outcome, heard.why) == (Outcome.PUBLISHED, report.outcome)
    assert "board0" in report.outcome
    assert (message["status"][0]["level"], report.published, report.is_biased) == (1, True, True)
    assert "nan" not in report.details.values()
    assert report.outcome in line(replace(read_posterior(result, 0), report=report), [Axis("Rain", 2)])


def test_a_result_goes_through_a_pipe(folder, capsys, monkeypatch):
    deployment = built(folder)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b'{"addresses": [1]}\n')))
    with opened(folder, deployment) as boards:
        compute_lines(boards, 1)
    printed = capsys.readouterr().out.encode()
    result = result_from_line(printed, 1, deployment.machine)
    machines = [image.machine for image in images_of(deployment)]
    frame = FrameInput(addresses=(1,), target_count=SAMPLES, max_cycles=2**32)
    boards = decode_boards(result.result)
    assert BM2.infer(boards).posterior.tolist() == BM2.posterior(machines, frame)[0].tolist()
    other = SimpleNamespace(kind=BM2, results=3, replicas=1, variables=deployment.machine.variables)
    with pytest.raises(InputLineError, match=r"line 4 .* 2 probabilities; expected .* 3 probabilities"):
        result_from_line(printed, 4, other)
    spoilt = json.loads(printed)
    spoilt["boards"][0]["counts"].pop()
    with pytest.raises(MachineError):
        result_from_line(json.dumps(spoilt).encode(), 1, deployment.machine)
    spoilt["boards"][0]["kept"] = "AAAA"
    with pytest.raises(MachineError):
        result_from_line(json.dumps(spoilt).encode(), 1, deployment.machine)
