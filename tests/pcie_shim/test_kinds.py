"""The second kind of machine, BM2, from its programming file over emulated boards to a posterior.

frame ──▶ on_host ── blocks ──▶ board 0, board 1 (chains) ── answers ──▶ course ──▶ infer
                        the same start ──▶ the reference in this process ── must be equal, to the bit
"""

import dataclasses

import msgspec
import numpy as np
import pytest

from machines import KINDS
from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason
from machines.bm2_kind import BATCHES, BM2, STREAM_BYTES_MAX, Kept
from machines.errors import MachineError, NoPosteriorError, ParameterError, StartError
from machines.kind import BoardResult, FrameInput
from machines.parameters import SampleEvery, Sequencer
from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import RefusedError
from pcie_shim.board.rtl_board import RtlBoard
from pcie_shim.errors import FrameInputError, ImageError, ImageMismatchError
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.programming_file import Image, Partition, image_bytes, image_from_bytes
from pcie_shim.register_map import ErrorCode
from services.boards.hardware import Engine, SimulatedHardware
from tests.machines.test_bm2 import EXACT
from tests.machines.test_bm2 import sprinkler as machine_of_the_thesis
from tests.pcie_shim.boards import board_fails, finish, loaded, opened, refused, words
from tests.pcie_shim.boards import image as bm1_image
from tests.pcie_shim.boards import machine as bm1_machine


def sprinkler(chain=0, chains=1, **parameters):
    return machine_of_the_thesis(**{"burn_in": 50, "chain": chain, "chains": chains} | parameters)


def weather(**parameters):
    """Three variables with unused codes; value 2 of the first is impossible."""
    built = BM2Parameters(
        cardinalities=(3, 5, 3),
        factors=((0,), (0, 1), (1, 2)),
        searched=(2, 1),
        known=(0,),
        **({"burn_in": 20} | parameters),
    )
    of_two = np.ones((5, 3))
    of_two[4, 2] = 0
    return BM2Machine.from_factors(built, (np.array([1.0, 2.0, 0.0]), np.arange(15.0).reshape(3, 5), of_two))


def wide(**parameters):
    """A chain of variables, whose state has two words."""
    built = BM2Parameters(
        cardinalities=(5,) * 12,
        factors=((0,), *((at, at + 1) for at in range(11))),
        searched=(0, 11),
        known=(10,),  # its code is in both words
        burn_in=3,
        **parameters,
    )
    random = np.random.default_rng(5)
    factors = [random.random(5), *(random.random((5, 5)) for _ in range(11))]
    return BM2Machine.from_factors(built, factors)


def image(machine):
    parameters = machine.parameters
    partition = Partition(parameters.chain, parameters.chains, parameters.chain, parameters.chains)
    return Image(machine, partition, 20, 1200, "ab" * 32, "2026-01-02T03:04:05Z", "0")


def images(count=1, **parameters):
    return [image(sprinkler(chain, count, **parameters)) for chain in range(count)]


def frame(*addresses, samples=300, **settings):
    return FrameInput(addresses=addresses, target_count=samples, **({"max_cycles": 2**32} | settings))


def expected(machine, *, state, known, samples=300, bank=0, batches=BATCHES, max_cycles=2**32):
    """The result words, cycles and reason, samples and unused, the words of the batches before, and the stream."""
    parameters, kernel = machine.parameters, BM2.kernel(machine)
    targets = [samples * (at + 1) // batches for at in range(batches)]
    first = targets[0] if not parameters.stream else samples
    kernel.start(
        BM2Start(
            state=state,
            known=known,
            samples=first,
            burn_in=parameters.burn_in,
            ops_timeout=parameters.ops_timeout,
            max_cycles=max_cycles,
            bank=bank,
            sequencer=parameters.sequencer,
        )
    )
    before, stream = [], kernel.stream.tobytes()
    while kernel.reason is BM2StopReason.FULL:
        kernel.resume(samples)
        stream += kernel.stream.tobytes()
    for target in targets[1:] if not parameters.stream else ():
        if kernel.reason is BM2StopReason.SAMPLES:
            before.append(kernel.results.tobytes())
            kernel.resume(target)
    done = (kernel.samples, kernel.unused)
    return (kernel.results.tolist(), kernel.cycles, kernel.reason, done, before, stream)


def found(result):
    kept = msgspec.msgpack.decode(result.kept, type=Kept)
    done = (kept.samples, kept.unused)
    return (result.counts.tolist(), result.cycles, result.reason, done, kept.batches, kept.stream)


@pytest.mark.parametrize("sequencer", Sequencer)
def test_two_boards_are_chains_equal_to_kernels(sequencer):
    parts = images(2, sequencer=sequencer)
    with opened(parts, sends_results=sequencer is not Sequencer.RANDOM) as cluster:
        for bank in (3, 4):
            output = cluster.run(frame(1, bank=bank))
            # the even board starts from the smallest state that has wet grass, the odd one from the largest
            wanted = [
                expected(part.machine, state=state, known=0b100, bank=bank)
                for part, state in zip(parts, (0b110, 0b111), strict=True)
            ]
            assert [found(board) for board in output.boards] == wanted
            assert output.slices == BATCHES
    inference = BM2.infer(output.boards, ("rain", "sprinkler", "grass"))
    assert (inference.outcome, inference.details["samples"]) == ("posterior", "600")
    assert inference.posterior[1] == pytest.approx(EXACT, abs=0.3)
    assert float(inference.details["r_hat"]) > 0.9
    # a chain that always saw the same rain may be stuck
    moved = all(board.counts[:2].all() for board in output.boards)
    assert ("effective_samples" in inference.details) == moved
    assert 0 < float(inference.details.get("effective_samples", 1)) <= 600
    assert (
        inference.posterior.tolist()
        == BM2.posterior([part.machine for part in parts], frame(1, bank=4))[0].tolist()
    )


@pytest.mark.parametrize("sample_every", SampleEvery)
def test_a_stream_that_is_full_makes_the_board_wait_and_changes_nothing(sample_every):
    streamed, plain = (images(stream=stream, sample_every=sample_every, burn_in=10)[0] for stream in (7, 0))
    with opened([streamed], sends_results=sample_every is SampleEvery.MOVE) as cluster:
        output = cluster.run(frame(1, samples=100))
    with opened([plain]) as cluster:
        whole = cluster.run(frame(1, samples=100))
    assert output.slices == -(-100 // 7)
    assert found(output.boards[0]) == expected(streamed.machine, state=0b110, known=0b100, samples=100)
    assert output.boards[0].counts.tolist() == whole.boards[0].counts.tolist()
    inference = BM2.infer(output.boards)
    assert (len(inference.samples), inference.sample_bytes) == (400, 4)
    states = np.frombuffer(inference.samples, "<u4")
    assert (states >> 2 == 1).all()
    assert np.bincount(states & 1, minlength=2).tolist() == output.boards[0].counts[:2].tolist()
    assert not BM2.infer(whole.boards).samples


def test_a_state_may_have_several_words():
    machine = wide(stream=6)
    with opened([image(machine)]) as cluster:
        output = cluster.run(frame(4, samples=40))
    assert found(output.boards[0]) == expected(machine, state=4 << 30, known=7 << 30, samples=40)
    inference = BM2.infer(output.boards)
    assert (inference.sample_bytes, len(inference.samples)) == (8, 320)
    assert inference.posterior.shape == (25,)


def test_readings_may_be_missing_and_codes_unused():
    machine = weather()
    with opened([image(machine)]) as cluster:
        output = cluster.run(frame(None))
    assert found(output.boards[0]) == expected(machine, state=0b00_001_00, known=0)
    inference = BM2.infer(output.boards)
    assert inference.posterior.sum() == pytest.approx(1)
    posterior = inference.posterior.reshape(3, 5)
    assert posterior[2, 4] == 0
    assert posterior[0, 4] > posterior[0, 0] > 0
    unused = int(inference.details["unused"])
    assert inference.details["samples"] == "300"
    assert inference.totals == [300 - unused]


def test_impossible_readings_are_no_error():
    machine = weather()
    with opened([image(machine)]) as cluster:
        for _ in range(2):
            output = cluster.run(frame(2))
            assert (output.boards[0].reason, output.boards[0].cycles) == (BM2StopReason.IMPOSSIBLE, 0)
            inference = BM2.infer(output.boards)
            assert inference.posterior is None
            assert "impossible" in inference.outcome
            assert cluster.run(frame(1, samples=5)).boards[0].reason == BM2StopReason.SAMPLES
    with pytest.raises(NoPosteriorError):
        BM2.posterior([machine], frame(2))


def test_a_board_that_times_out_is_left_out_and_named():
    names = ("rain", "sprinkler", "grass")
    with opened(images()) as cluster:
        good = cluster.run(frame(1)).boards[0]
    with opened(images(ops_timeout=1)) as cluster:
        late = cluster.run(frame(1)).boards[0]
    assert late.reason == BM2StopReason.OPS_TIMEOUT
    alone, both = BM2.infer([late], names), BM2.infer([good, late], names)
    assert alone.posterior is None
    (name,) = (name for name in names if name in alone.outcome)
    for sentence, board in ((alone.outcome, "board0"), (both.details["left_out"], "board1")):
        assert board in sentence
        assert name in sentence
        assert "--ops-timeout" in sentence
    assert both.details["samples"] == "300"
    assert both.posterior.tolist() == BM2.infer([good]).posterior.tolist()


def test_samples_of_a_board_that_is_left_out_are_not_handed_on():
    parameters = sprinkler(stream=4).parameters
    counts = np.ones(parameters.result_words, "<u4").tobytes()
    boards = []
    for reason, states in ((BM2StopReason.OPS_TIMEOUT, (5, 5)), (BM2StopReason.SAMPLES, (4, 6, 7))):
        kept = Kept(parameters, len(states), 1, timed_out_bit=0, stream=bytearray(words(*states)))
        boards.append(BoardResult(counts, 9, reason, kept=msgspec.msgpack.encode(kept)))
    inference = BM2.infer(boards)
    assert inference.samples == words(4, 6, 7)
    assert (inference.details["samples"], inference.details["unused"]) == ("3", "1")
    assert inference.totals == [1, 2]


def test_a_time_out_of_a_variable_without_a_name_has_its_number():
    parameters = BM2Parameters(
        cardinalities=(2, 2), factors=((0,), (1,), (1,)), searched=(1,), known=(0,), ops_timeout=1
    )
    factors = ([0.5, 0.5], [0.001, 0.999], [0.999, 0.001])
    with opened([image(BM2Machine.from_factors(parameters, factors))]) as cluster:
        late = cluster.run(frame(0)).boards
    assert "variable 1" in BM2.infer(late, ("only",)).outcome


def result_with(machine, *samples, reason=BM2StopReason.SAMPLES, **kept):
    """A result as it may come from a pipe."""
    parameters = machine.parameters
    packed = msgspec.msgpack.encode(Kept(parameters, *samples, **kept))
    return BoardResult(bytes(4 * parameters.result_words), 9, reason, kept=packed)


@pytest.mark.parametrize(
    "result",
    [
        *(result_with(sprinkler(), *samples) for samples in ((-5, 0), (2, 3), (2, -1))),
        *(
            result_with(sprinkler(), reason=BM2StopReason.OPS_TIMEOUT, timed_out_bit=bit)
            for bit in (-2, -1, 3)  # the state has three bits
        ),
        result_with(wide(stream=6), 1, stream=bytearray(4)),  # half a state
    ],
)
def test_a_result_that_no_machine_gives_is_refused(result):
    with pytest.raises(MachineError, match="does not match"):
        BM2.infer([result])


def test_results_of_several_boards_are_of_one_model():
    BM2.infer([result_with(wide(stream=6), 1, stream=bytearray(8))])
    with pytest.raises(MachineError, match="different models"):
        BM2.infer([result_with(sprinkler()), result_with(wide())])


def test_a_result_that_ended_by_max_cycles_is_marked():
    with opened(images()) as cluster:
        inference = BM2.infer(cluster.run(frame(1, max_cycles=900)).boards)
    assert "board0" in inference.details["ended_early"]
    assert "board0" in inference.outcome
    assert inference.posterior is not None
    # too few batches to know them
    assert not {"effective_samples", "standard_error", "r_hat"} & set(inference.details)


@pytest.mark.parametrize(
    ("given", "settings", "word"),
    [
        ((2,), {}, "address"),
        ((-1,), {}, "address"),
        ((1, 1), {}, "readings"),
        ((1,), {"samples": 0}, "samples"),
        ((1,), {"bank": 16}, "bank"),
        ((1,), {"max_cycles": 0}, "cycles"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused_before_the_boards(given, settings, word):
    with opened(images()) as cluster:
        with pytest.raises(FrameInputError, match=word):
            cluster.run(frame(*given, **settings))
        assert cluster.run(frame(1, samples=5)).boards[0].reason == BM2StopReason.SAMPLES


def test_frames_that_no_chain_can_run_are_refused():
    with opened([image(sprinkler(known=(0, 1, 2), searched=()))]) as cluster, pytest.raises(FrameInputError):
        cluster.run(frame(1, 1, 1))
    with pytest.raises(ParameterError):
        images(stream=4097)
    with opened(images(stream=8)) as cluster, pytest.raises(FrameInputError):
        cluster.run(frame(1, samples=STREAM_BYTES_MAX // 4 + 1))


def board_with(machine):
    return loaded(image(machine))


@pytest.mark.parametrize(
    "writes",
    [
        {rm.RUN_UNTIL: words(256, 0)},
        {rm.START_STATE: words(0b11), rm.KNOWN_MASK: words(0b11)},  # a code that is no value
        {rm.START_STATE: words(1 << 7)},
        {rm.KNOWN_MASK: words(0b1)},
        {rm.KNOWN_MASK: words(0b1111111)},
        {rm.ORDER: words(3)},
        {rm.OPS_TIMEOUT: words(0)},
        {rm.BANK: words(16)},
        {rm.PRIOR_SELECT: words(1)},
        {rm.MAX_CYCLES: words(0, 0)},
    ],
)
def test_a_board_refuses_a_start_that_does_not_fit(writes):
    board = board_with(weather())
    board.write(rm.TARGET_COUNT, words(10, 1 << 20, 0, 0, 0, 0, 0))
    for address, value in writes.items():
        board.write(address, value)
    with refused(ErrorCode.BAD_VALUE):
        board.write(rm.START, words(1))
    assert not board.running
    assert board.done == 0


def test_a_start_state_that_is_too_hard_is_no_crash(monkeypatch):
    """A board refuses the image; a host searches once for the same readings."""
    calls = []

    def search(*arguments, **flags):
        calls.append(arguments)
        raise StartError("The search takes too long.")

    monkeypatch.setattr("machines.bm2_kind.start_state", search)
    with refused(ErrorCode.BAD_IMAGE):
        board_with(weather())
    calls.clear()
    host = BM2.on_host([weather()])
    for _ in range(2):
        with pytest.raises(StartError, match="too long"):
            host.begin(frame(1))
    assert len(calls) == 1


def test_a_refused_start_leaves_the_limit_of_the_frame_before(monkeypatch):
    """A resume after it still runs in chunks, between which the board reads."""
    board = board_with(weather())
    board.write(rm.TARGET_COUNT, words(10, 1 << 30, 0, 0, 0, 0, 0))
    board.write(rm.START, words(1))
    finish(board)
    board.write(rm.TARGET_COUNT, words(10, 1, 0, 0, 0, 0, 0))
    board.write(rm.ORDER, words(9))
    with pytest.raises(RefusedError):
        board.write(rm.START, words(2))
    board.write(rm.TARGET_COUNT, words(2**31))
    monkeypatch.setattr(
        "machines.bm2_kernel.BM2Kernel.resume", lambda _, samples, pause_at: ends.append(pause_at)
    )
    ends = []
    board.write(rm.RESUME, words(2))
    assert ends[0] > 0


def test_an_image_is_of_the_same_board_as_its_machine():
    whole = images(2)[1]
    with pytest.raises(ImageError, match=r"part \(number, of\) \(1, 2\), the image \(0, 2\)"):
        dataclasses.replace(whole, partition=Partition(0, 2, 0, 2))


def test_a_board_has_the_registers_of_its_kind():
    board = board_with(weather(stream=8))
    for absent in (rm.SENSORS, rm.INPUTS, rm.PRIOR_CODES, rm.OUTCOMES):
        with pytest.raises(RefusedError):
            board.read(absent, 1)
    for readable in (rm.SAMPLES_DONE, rm.UNUSED, rm.TIMED_OUT_BIT, rm.STREAM_COUNT, rm.STREAM + 28):
        board.read(readable, 1)
        with pytest.raises(RefusedError):
            board.write(readable, words(1))
    with pytest.raises(RefusedError):
        board.read(rm.STREAM + 32, 1)
    (machine,) = np.frombuffer(board.read(rm.CAP_MACHINE, 1), "<u4")
    assert machine & rm.CAP_MACHINE_KIND_MASK == 2
    assert machine & rm.CAP_MACHINE_STREAM_MASK
    plain = loaded(bm1_image(bm1_machine()))
    for absent in (rm.START_STATE, rm.KNOWN_MASK, rm.BURN_IN, rm.SAMPLES_DONE, rm.STREAM):
        with pytest.raises(RefusedError):
            plain.read(absent, 1)


def test_a_resume_needs_more_samples_and_a_run_to_resume():
    board = board_with(weather())
    board.write(rm.TARGET_COUNT, words(10, 1 << 30, 0, 0, 0, 0, 0))
    with pytest.raises(RefusedError):
        board.write(rm.RESUME, words(1))
    board.write(rm.START_STATE, words(0b00100))
    board.write(rm.START, words(1))
    finish(board)
    with refused(ErrorCode.BAD_VALUE):
        board.write(rm.RESUME, words(2))
    board.write(rm.TARGET_COUNT, words(12))
    board.write(rm.RESUME, words(2))
    finish(board)
    assert board.read(rm.SAMPLES_DONE, 1) == words(12)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_host_refuses_a_board_with_the_image_of_the_other_kind(start_board, is_first):
    endpoint = start_board().endpoint
    other, ours = sorted(
        (images()[0], bm1_image(bm1_machine())), key=lambda each: (each.kind is BM2) != is_first
    )
    with MiniCluster.open([endpoint], [other]):
        pass
    with board_fails(ImageMismatchError):
        MiniCluster.open([endpoint], [ours])
    MiniCluster.open([endpoint], [ours], reprogram=True).close()


def test_simulated_hardware_of_the_other_kind_refuses_it(monkeypatch, tmp_path):
    monkeypatch.setattr("toolchain.hardware.check_tools", lambda _: None)
    hardware = SimulatedHardware(Engine.GHDL, tmp_path, {})
    board = RtlBoard(hardware._simulate)
    with pytest.raises(RefusedError, match="BM2") as caught:
        board.load(image_bytes(images()[0]))
    assert caught.value.code is ErrorCode.BAD_IMAGE


def test_a_programming_file_names_its_kind(monkeypatch):
    part = images(stream=3, sequencer="coloured")[0]
    content = image_bytes(part)
    again = image_from_bytes(content)
    assert (again.kind, again.machine) == (BM2, part.machine)
    monkeypatch.delitem(KINDS, BM2.name)
    with pytest.raises(ImageMismatchError, match="BM2"):
        image_from_bytes(content)
