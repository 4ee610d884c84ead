"""A second kind of machine, which nobody outside `machines` has heard of, from its programming file to a posterior."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from machines import KINDS
from machines.errors import StartError
from machines.kind import (
    BoardMachine,
    FrameCourse,
    FrameInput,
    FrameSettings,
    HostMachine,
    Inference,
    MachineKind,
    UsedRegisters,
)
from pcie_shim.errors import FrameInputError, ImageMismatchError
from pcie_shim.programming_file import Image, Partition, image_bytes, image_from_bytes
from tests.pcie_shim.boards import opened


@dataclass(frozen=True)
class Weights:
    """The parameters of a machine that multiplies its input by weights, one cycle for each unit of the target."""

    lines: int


class OnBoard(BoardMachine):
    paused, reason, cycles = False, 0, 0

    def __init__(self, machine, memory):
        self._machine, self._memory = machine, memory

    def reset(self):
        self.paused, self.reason, self.cycles = False, 0, 0

    prepare = reset

    def start(self, settings, end):
        self._target, self.cycles = settings.target_count, 0
        self._memory["RESULTS"][: 4 * self._machine.parameters.lines] = (
            self._machine.weights * np.frombuffer(self._memory["SENSORS"], "<u4", 1)
        ).tobytes()
        self.step(end)

    def step(self, end):
        self.cycles = min(self._target, end or self._target)
        self.paused = self.cycles < self._target
        self.reason = 7 if self.paused else 9

    resume = step

    @property
    def resumable(self):
        return self.paused


class Course(FrameCourse):
    def __init__(self, settings, starts):
        self.settings, self.starts, self.begun, self.end = settings, starts, 0, 2

    def proceed(self, boards):
        self.begun, self.end = self.end, 0
        return [at for at, board in enumerate(boards) if board.reasons == (7,)], {}


class OnHost(HostMachine):
    def __init__(self, machines):
        self._machines = machines

    def begin(self, frame):
        if frame.addresses[0] is None:
            raise StartError("this machine needs a reading.")
        words = np.array(frame.addresses, "<u4").tobytes()
        settings = FrameSettings(frame.target_count, frame.max_cycles, frame.bank, 0)
        return Course(settings, [{"SENSORS": words}] * len(self._machines))

    def slowest(self):
        return FrameInput(addresses=(1,), target_count=5, max_cycles=9)


class Weighing(MachineKind):
    name, has_hardware, parameters = "WEIGHING", False, Weights
    reasons: ClassVar = {0: "not started", 7: "paused", 9: "weighed"}

    def sections(self, machine):
        return [("weights", machine.weights)]

    def due_sections(self, parameters):
        yield "weights", "<u4", (parameters.lines,)

    def machine(self, parameters, sections):
        return SimpleNamespace(parameters=parameters, weights=sections["weights"])

    def registers(self, parameters):
        capabilities = {"CAP_MACHINE.KIND": 99, "CAP_LINES": parameters.lines, "CAP_REPLICAS": 1}
        return UsedRegisters(
            lines=parameters.lines,
            replicas=1,
            inputs="SENSORS",
            input_words=1,
            result_words=parameters.lines,
            answer={"RESULTS": parameters.lines},
            capabilities=capabilities,
            size="one input",
        )

    def contents(self, machine):
        return {}

    def kernel(self, machine):
        return machine

    on_board, on_host, joint_reason = staticmethod(OnBoard), staticmethod(OnHost), staticmethod(max)

    def infer(self, results, variables=()):
        counts = np.concatenate([board.counts for board in results])
        return Inference(results, counts / counts.sum(), [int(board.counts.sum()) for board in results], "")

    def posterior(self, machines, frame, variables=()):
        raise NotImplementedError


KIND = Weighing()


@pytest.fixture
def parts(monkeypatch):
    """The images of two boards, with the weights 1, 2 and 5."""
    monkeypatch.setitem(KINDS, KIND.name, lambda: KIND)
    images = []
    for at, weights in enumerate(([1, 2], [5])):
        machine = KIND.machine(Weights(len(weights)), {"weights": np.array(weights, "<u4")})
        images.append(
            Image(machine, Partition(at, 2, 2 * at, 3), 1, 3, "ab" * 32, "2026-01-02T03:04:05Z", "0")
        )
    return images


def test_it_runs_on_boards_and_gives_a_posterior(parts):
    with opened(parts) as cluster:
        for reading, slices in ((3, 2), (8, 2)):
            output = cluster.run(FrameInput(addresses=(reading,), target_count=5, max_cycles=9))
            assert [board.counts.tolist() for board in output.boards] == [
                [reading, 2 * reading],
                [5 * reading],
            ]
            assert [(board.cycles, board.reason) for board in output.boards] == [(5, 9)] * 2
            assert output.slices == slices
            inference = parts[0].kind.infer(output.boards)
            assert inference.posterior.tolist() == [1 / 8, 2 / 8, 5 / 8]
            assert inference.best == 2
        with pytest.raises(FrameInputError):
            cluster.run(FrameInput(addresses=(None,), target_count=5, max_cycles=9))


def test_a_programming_file_names_its_kind(parts, monkeypatch):
    content = image_bytes(parts[0])
    found = image_from_bytes(content)
    assert (found.kind, found.machine.parameters, found.machine.weights.tolist()) == (
        KIND,
        Weights(2),
        [1, 2],
    )
    monkeypatch.delitem(KINDS, KIND.name)
    with pytest.raises(ImageMismatchError, match="WEIGHING"):
        image_from_bytes(content)
