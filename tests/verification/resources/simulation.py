"""Frames on the reference machine, and the same frames on its Verilog text in a simulator."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from machines.bm1 import BM1Machine, Start, StopReason, missing_inputs
from machines.parameters import PriorMode
from machines.reference import ReferenceBM1
from tests.verification.resources import verilog
from tests.verification.resources.cases import Case, machine_of
from tests.verification.resources.tools import run


@dataclass(frozen=True)
class Outcome:
    """A machine's registers at the end of a slice; a single machine is one replica."""

    reason: StopReason
    cycles: int
    replica_reasons: tuple[StopReason, ...]
    replica_cycles: tuple[int, ...]
    counts: tuple[int, ...]
    states: tuple[int, ...]


@dataclass(frozen=True)
class Frame:
    """A start, and the resumes that follow slices: each one's end, and the replicas that it halts."""

    start: Start
    resumes: tuple[tuple[int, tuple[int, ...]], ...] = ()


def frames_of(case: Case) -> list[Frame]:
    """Return frames that end in every way, by themselves or after slices; replicas have inputs of their own."""
    parameters = case.parameters
    random = np.random.default_rng(case.seed + 1000)
    replicas, several = parameters.replicas, parameters.replicas > 1
    # row 1 of every table has no line that can count; as a code 0 says the same
    never = 1 if parameters.has_tables else 0
    rows = random.integers(0, parameters.ones_code + 1, (6, *parameters.count_shape)).astype(np.uint16)

    def inputs():
        drawn = np.empty(parameters.input_shape, dtype=np.int64)
        by_column = drawn.reshape(replicas, parameters.sensors, -1)
        for column, bits in enumerate(parameters.sensor_bits):
            choice = [each for each in range(1 << bits) if each != never]
            by_column[:, column] = random.choice(choice, by_column[:, column].shape)
        return drawn

    def start(at, where, target, limit, until=0):
        prior = at % parameters.prior_addresses
        others = tuple((at + replica) % parameters.prior_addresses for replica in range(replicas))
        return Start(
            addresses=tuple(where.tolist()) if where.ndim == 1 else where,
            prior_address=others if several else prior,
            prior_codes=rows[at] if parameters.prior_mode is PriorMode.WRITTEN and at else None,
            target_count=min(target, parameters.target_count_max),
            max_cycles=limit,
            bank=at % parameters.rng_banks,
            run_until=until,
        )

    def hopeless(which):
        where = inputs()
        where.reshape(replicas, parameters.sensors, -1)[which, 0] = never
        return where

    missing = np.array(missing_inputs(parameters), dtype=np.int64)
    frames = [
        Frame(start(0, inputs(), 200, 64)),
        Frame(start(1, inputs(), 5, 400)),
        Frame(start(2, inputs(), 255, 100, until=31), ((57, ()),)),
        Frame(start(3, hopeless(slice(None)), 9, 50)),
        Frame(start(4, missing, 30, 300)),
        Frame(start(5, inputs(), 3, 200, until=64), ((0, ()),)),
    ]
    if several:  # one can't count, one is left behind at the first slice, and another one at the second
        resumes = ((32, (1,)), (64, (replicas - 1,)), (0, ()))
        frames.append(Frame(start(1, hopeless(slice(0, 1)), 250, 140, until=8), resumes))
        frames.append(Frame(start(2, inputs(), 12, 150, until=16), ((48, ()), (0, (0,)))))
    return frames


def reference(machine: BM1Machine, frames: Sequence[Frame]) -> tuple[list[Outcome], list[Frame]]:
    """Return the reference machine's outcomes, and the frames with those of their resumes that it took."""
    kernel = ReferenceBM1(machine)
    outcomes, played = [], []
    for frame in frames:
        kernel.start(frame.start)
        resumes = []
        left = set(range(machine.parameters.replicas))
        for until, wanted in frame.resumes:
            if kernel.reason is not StopReason.SLICE:
                break
            can = {at for at in left if kernel.replica_reasons[at] is StopReason.SLICE}
            halted = wanted if can - set(wanted) else ()  # at least one has to go on
            left -= set(halted)
            kernel.resume(until, halted)
            resumes.append((until, halted))
        played.append(Frame(frame.start, tuple(resumes)))
        counts, states = (tuple(each.ravel().tolist()) for each in (kernel.counts, kernel.rng_state))
        ends = (kernel.reason, kernel.cycles, kernel.replica_reasons, kernel.replica_cycles)
        outcomes.append(Outcome(*ends, counts, states))
    return outcomes, played


def register_writes(machine: BM1Machine, start: Start) -> dict[int, int]:
    """Return what a host writes before a frame: values by the registers' addresses."""
    parameters, places = machine.parameters, verilog.Places(machine.parameters)
    selects = np.broadcast_to(np.asarray(start.prior_address), (parameters.replicas,)).tolist()
    given = np.asarray(start.addresses).ravel().tolist()
    writes = {
        verilog.TARGET: start.target_count,
        verilog.MAX_CYCLES: start.max_cycles,
        verilog.MAX_CYCLES + 1: 0,
        verilog.RUN_UNTIL: start.run_until,
        verilog.RUN_UNTIL + 1: 0,
        verilog.BANK: start.bank,
        **{verilog.PRIOR_ADDRESSES + replica: address for replica, address in enumerate(selects)},
        **{places.inputs + at: address for at, address in enumerate(given)},
    }
    if parameters.prior_mode is PriorMode.WRITTEN:
        prior = machine.prior[0] if start.prior_codes is None else start.prior_codes
        codes = np.broadcast_to(prior, (parameters.replicas, parameters.lines)).ravel().tolist()
        writes |= {places.prior_codes + at: code for at, code in enumerate(codes)}
    return writes


def testbench(machine: BM1Machine, frames: Sequence[Frame]) -> str:
    """Return a bench that writes the registers as a host does, and prints the outcomes."""
    parameters, places = machine.parameters, verilog.Places(machine.parameters)
    generators = parameters.columns * (1 if parameters.shared else parameters.lines)
    results, several = parameters.replicas * parameters.lines, parameters.replicas > 1
    steps = []
    for frame in frames:
        writes = register_writes(machine, frame.start)
        steps += [f"put({address}, {value});" for address, value in writes.items()]
        steps += [f"put({verilog.CONTROL}, 1);", "finish;"]
        for until, halted in frame.resumes:
            mask = sum(1 << replica for replica in halted)
            halt = [
                f"put({places.halt + word}, {mask >> verilog.WORD_BITS * word & 0xFFFFFFFF});"
                for word in range(places.end - places.halt)
            ]
            steps += [f"put({verilog.RUN_UNTIL}, {until});", *halt, f"put({verilog.CONTROL}, 2);", "finish;"]
        states = " ".join(f'$write(" %0d", dut.random_{at});' for at in range(generators))
        words = f"for (i = {places.outcomes}; i < {places.outcomes + verilog.OUTCOME_WORDS * parameters.replicas}; i = i + 1) begin"
        steps += [
            '$write("%0d %0d", reason, cycles);',
            *(
                [words, '  read_address = i; @(negedge clk); $write(" %0d", read_data); end']
                if several
                else []
            ),
            f"for (i = 0; i < {results}; i = i + 1) begin",
            '  read_address = i; @(negedge clk); $write(" %0d", read_data); end',
            states,
            '$display("");',
        ]
    body = "\n    ".join(steps)
    return f"""
module bench;
  reg clk = 0, reset = 1, write = 0; reg [31:0] write_data = 0; reg [31:0] read_address = 0, write_address = 0;
  wire [31:0] read_data; wire [63:0] cycles; wire [2:0] reason; wire done; integer i;
  always #1 clk = ~clk;
  bm1 dut (.clk(clk), .reset(reset), .write(write), .write_address(write_address), .write_data(write_data),
    .read_address(read_address), .read_data(read_data), .cycles(cycles), .reason(reason), .done(done));
  task put(input [31:0] address, input [31:0] value);
    begin write = 1; write_address = address; write_data = value; @(negedge clk); write = 0; end
  endtask
  task finish; begin @(negedge clk); while (!done) @(negedge clk); end endtask
  initial begin
    repeat (3) @(negedge clk); reset = 0;
    {body}
    $finish;
  end
  initial begin #200000 $display("late"); $finish; end
endmodule
"""


def simulated(case: Case, frames: Sequence[Frame], folder: Path) -> list[Outcome]:
    """Return the outcomes of the text in Icarus Verilog."""
    machine = machine_of(case)
    text = folder / "bm1.v"
    text.write_text(verilog.verilog(machine, tables=True) + testbench(machine, frames))
    run(["iverilog", "-g2005", "-Wno-portbind", "-s", "bench", "-o", str(folder / "bm1.vvp"), str(text)])
    printed = run(["vvp", "-n", str(folder / "bm1.vvp")]).splitlines()
    parameters = case.parameters
    outcomes = []
    for line in printed:
        if not line[:1].isdigit():
            raise AssertionError(f"the simulation of {case.name} printed {line!r}")
        reason, cycles, *rest = map(int, line.split())
        reasons, lengths = [StopReason(reason)], [cycles]
        if parameters.replicas > 1:
            words = [rest[at : at + verilog.OUTCOME_WORDS] for at in range(0, 4 * parameters.replicas, 4)]
            reasons = [StopReason(word[0]) for word in words]
            lengths = [word[2] + (word[3] << 32) for word in words]
            rest = rest[verilog.OUTCOME_WORDS * parameters.replicas :]
        results = parameters.replicas * parameters.lines
        counts, states = tuple(rest[:results]), tuple(rest[results:])
        outcomes.append(Outcome(StopReason(reason), cycles, tuple(reasons), tuple(lengths), counts, states))
    return outcomes
