"""The resource estimator beside a synthesis, and the synthesised text beside the reference machine: scripts/verify resources.

small machines --> toolchain.analysis.rtl (Verilog) --> Icarus Verilog --> counts, cycles, reasons, states: the reference's, to the bit?
                                          └--> yosys synth_intel_alm --> ALUTs, registers: what toolchain.analysis.logic says?
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from machines.bm1 import BM1Machine, Start, StopReason, missing_inputs
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from machines.reference import ReferenceBM1, ReferenceReplicas
from toolchain.analysis import rtl
from toolchain.analysis.logic import COSTS, Alms, Of, logic_of

LIMIT_S = 240.0
"""For one run of a tool."""
TOLERANCE = 0.15
"""How far an estimate may be from the synthesis, of ALUTs and of ALMs; registers are counted, and must be the same."""
FIT_ROUNDS = 20_000
"""Of a descent along one cost after the other; further ones change no third digit."""
ADDRESS_BITS = 4


@dataclass(frozen=True)
class Case:
    """A small machine; `seed` makes its tables and frames."""

    parameters: BM1Parameters
    seed: int

    @property
    def name(self) -> str:
        """Lines x sensors, and what is not the default."""
        p = self.parameters
        return (
            f"{p.lines}x{p.sensors}, codes {p.prob_bits}, counters {p.counter_bits}, {p.rng}"
            + ("" if p.shared else " a cell")
            + f", {p.steps_per_clock} steps, {p.rng_banks} banks"
            + (", free" if p.rng_reset is RngReset.FREE else "")
            + (", written prior" if p.prior_mode is PriorMode.WRITTEN else "")
            + (f", {p.sensor_mode}" if p.sensor_mode is not SensorMode.COLUMN else "")
            + (f", {p.replicas} replicas" if p.replicas > 1 else "")
        )


def case(lines: int, sensors: int, seed: int, **others: Any) -> Case:
    """A machine of these sizes."""
    width = others.get("prob_bits", 8) if others.get("sensor_mode") is SensorMode.THRESHOLD else ADDRESS_BITS
    return Case(BM1Parameters(lines=lines, sensor_bits=(width,) * sensors, **others), seed)


SIMULATED = (
    case(4, 2, 1),
    case(8, 3, 2),
    case(16, 4, 3),
    case(5, 1, 4, prob_bits=4, counter_bits=4, rng=RngKind.LFSR8, rng_banks=1),
    case(6, 3, 5, prob_bits=12, rng=RngKind.LFSR16, steps_per_clock=1, prior_bits=2),
    case(4, 2, 6, rng=RngKind.LFSR24, rng_reset=RngReset.FREE),
    case(4, 2, 7, shared=False, rng_banks=3),
    case(4, 2, 8, prior_mode=PriorMode.WRITTEN),
    case(5, 2, 13, sensor_mode=SensorMode.CELL),
    case(4, 3, 14, sensor_mode=SensorMode.THRESHOLD, prob_bits=6),
    case(4, 2, 15, replicas=3),
    case(3, 2, 16, replicas=5, prior_bits=2, rng=RngKind.LFSR16, steps_per_clock=1),
    case(4, 2, 17, replicas=3, sensor_mode=SensorMode.CELL, rng_banks=1),
    case(3, 2, 18, replicas=4, sensor_mode=SensorMode.THRESHOLD, rng_reset=RngReset.FREE),
    case(3, 2, 19, replicas=3, prior_mode=PriorMode.WRITTEN, shared=False, rng_banks=2),
    case(1, 1, 20, replicas=40, sensor_mode=SensorMode.CELL, counter_bits=4),
)
CELL, THRESHOLD, WRITTEN = SensorMode.CELL, SensorMode.THRESHOLD, PriorMode.WRITTEN
SYNTHESISED = (
    case(12, 5, 4),
    case(24, 2, 5, prob_bits=6),
    case(10, 3, 6, prob_bits=10, counter_bits=12),
    case(6, 4, 7, rng=RngKind.LFSR24, rng_banks=8),
    case(20, 2, 8, counter_bits=20, rng_banks=1),
    case(6, 3, 9, shared=False, rng_banks=1, rng=RngKind.LFSR16),
    case(40, 3, 10),
    case(64, 1, 11, counter_bits=32),
    case(128, 1, 12),
    case(48, 2, 13, sensor_mode=CELL),
    case(24, 3, 14, sensor_mode=THRESHOLD, prob_bits=10),
    case(6, 3, 15, replicas=6),
    case(3, 1, 16, replicas=24, counter_bits=12),
    case(10, 2, 17, replicas=5, sensor_mode=CELL, rng=RngKind.LFSR24),
    case(12, 1, 18, replicas=6, sensor_mode=THRESHOLD, prob_bits=6),
    case(10, 2, 19, replicas=3, prior_mode=WRITTEN),
)
"""None of them is one of those that the estimator is calibrated on."""
CALIBRATION = (
    case(2, 1, 1),
    case(4, 2, 1),
    case(8, 3, 1),
    case(16, 4, 1),
    case(8, 6, 1),
    case(32, 3, 1),
    case(48, 2, 1),
    case(8, 3, 1, prob_bits=4),
    case(8, 3, 1, prob_bits=12),
    case(8, 2, 1, prob_bits=16),
    case(16, 2, 1, counter_bits=16),
    case(16, 2, 1, counter_bits=4),
    case(24, 1, 1, counter_bits=32),
    case(6, 5, 1, prob_bits=6, counter_bits=12),
    case(12, 4, 1, prior_bits=3),
    case(8, 3, 1, rng_banks=1),
    case(8, 3, 1, rng_banks=64),
    case(8, 3, 1, rng=RngKind.LFSR16),
    case(8, 3, 1, rng=RngKind.LFSR24),
    case(8, 3, 1, steps_per_clock=1),
    case(8, 3, 1, rng_reset=RngReset.FREE),
    case(8, 2, 1, shared=False, rng_banks=1, rng=RngKind.LFSR16),
    case(4, 3, 1, shared=False, rng_banks=4),
    case(4, 2, 1, prior_mode=WRITTEN),
    case(24, 2, 1, prior_mode=WRITTEN),
    case(4, 2, 1, sensor_mode=CELL),
    case(8, 3, 1, sensor_mode=CELL),
    case(16, 2, 1, sensor_mode=CELL),
    case(32, 2, 1, sensor_mode=CELL),
    case(4, 2, 1, sensor_mode=THRESHOLD),
    case(8, 3, 1, sensor_mode=THRESHOLD),
    case(16, 2, 1, sensor_mode=THRESHOLD),
    case(16, 2, 1, sensor_mode=THRESHOLD, prob_bits=12),
    case(16, 2, 1, sensor_mode=THRESHOLD, prob_bits=4),
    case(4, 2, 1, replicas=2),
    case(4, 2, 1, replicas=4),
    case(4, 2, 1, replicas=8),
    case(8, 2, 1, replicas=4),
    case(2, 2, 1, replicas=16),
    case(1, 1, 1, replicas=32),
    case(4, 2, 1, replicas=4, counter_bits=16),
    case(4, 2, 1, replicas=4, shared=False, rng_banks=1, rng=RngKind.LFSR16),
    case(16, 1, 1, replicas=3, prob_bits=6, rng=RngKind.LFSR24),
    case(4, 2, 1, replicas=4, prior_mode=WRITTEN),
    case(8, 2, 1, replicas=4, sensor_mode=CELL),
    case(4, 3, 1, replicas=8, sensor_mode=CELL),
    case(8, 2, 1, replicas=4, sensor_mode=THRESHOLD),
)
"""What `toolchain.analysis.logic.COSTS` are fitted to."""


def machine_of(case: Case) -> BM1Machine:
    """The case's machine, with random tables, a fifth of their codes 0 or all-ones."""
    parameters = case.parameters
    random = np.random.default_rng(case.seed)

    def codes(rows: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
        table = random.integers(1, parameters.ones_code, (rows, parameters.lines)).astype(np.uint16)
        kind = random.random(table.shape)
        table[kind < 0.05] = 0
        table[kind > 0.85] = parameters.ones_code
        return table

    tables = [codes(1 << bits) for bits in parameters.sensor_bits]
    if not parameters.has_tables:
        tables = []
    for table in tables:
        table[1] = 0  # an address on which no line can count
        table[-1] = parameters.ones_code
    return BM1Machine(parameters, codes(parameters.prior_addresses), tuple(tables))


@dataclass(frozen=True)
class Outcome:
    """What a machine shows at the end of a slice; a single machine is one replica."""

    reason: StopReason
    cycles: int
    replica_reasons: tuple[StopReason, ...]
    replica_cycles: tuple[int, ...]
    counts: tuple[int, ...]
    states: tuple[int, ...]


@dataclass(frozen=True)
class Frame:
    """A start, and what follows where it ends with its slice: the resumes' ends, each with the replicas that they halt."""

    start: Start
    resumes: tuple[tuple[int, tuple[int, ...]], ...] = ()


def frames_of(case: Case) -> list[Frame]:
    """Frames that end in every way, by themselves or after slices; replicas have inputs of their own."""
    parameters = case.parameters
    random = np.random.default_rng(case.seed + 1000)
    replicas, several = parameters.replicas, parameters.replicas > 1
    # row 1 of every table has no line that can count; as a code 0 says the same
    never = 1 if parameters.has_tables else 0
    rows = random.integers(0, parameters.ones_code + 1, (6, *parameters.count_shape)).astype(np.uint16)

    def inputs() -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        drawn = np.empty(parameters.input_shape, dtype=np.int64)
        by_column = drawn.reshape(replicas, parameters.sensors, -1)
        for column, bits in enumerate(parameters.sensor_bits):
            choice = [each for each in range(1 << bits) if each != never]
            by_column[:, column] = random.choice(choice, by_column[:, column].shape)
        return drawn

    def start(
        at: int,
        where: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
        target: int,
        limit: int,
        until: int = 0,
    ) -> Start:
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

    def hopeless(which: slice) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        where = inputs()
        where.reshape(replicas, parameters.sensors, -1)[which, 0] = never
        return where

    missing = np.array(missing_inputs(parameters), dtype=np.int64)
    return [
        Frame(start(0, inputs(), 200, 64)),
        Frame(start(1, inputs(), 5, 400)),
        Frame(start(2, inputs(), 255, 100, until=31), ((57, ()),)),
        Frame(start(3, hopeless(slice(None)), 9, 50)),
        Frame(start(4, missing, 30, 300)),
        Frame(start(5, inputs(), 3, 200, until=64), ((0, ()),)),
        *(
            [
                # one can't count, one is left behind at the first slice, and another one at the second
                Frame(
                    start(1, hopeless(slice(0, 1)), 250, 140, until=8),
                    ((32, (1,)), (64, (replicas - 1,)), (0, ())),
                ),
                Frame(start(2, inputs(), 12, 150, until=16), ((48, ()), (0, (0,)))),
            ]
            if several
            else []
        ),
    ]


def reference(machine: BM1Machine, frames: Sequence[Frame]) -> tuple[list[Outcome], list[Frame]]:
    """What the reference machine shows, and the frames with those of their resumes that it took."""
    kernel = ReferenceBM1(machine) if machine.parameters.replicas == 1 else ReferenceReplicas(machine)
    outcomes, played = [], []
    for frame in frames:
        kernel.start(frame.start)
        resumes = []
        left = set(range(machine.parameters.replicas))
        for until, wanted in frame.resumes:
            if kernel.reason is not StopReason.SLICE:
                break
            can = {at for at in left if kernel.replica_reasons[at] is StopReason.SLICE}
            halted = wanted if can - set(wanted) else ()  # somebody has to go on
            left -= set(halted)
            kernel.resume(until, halted)
            resumes.append((until, halted))
        played.append(Frame(frame.start, tuple(resumes)))
        outcomes.append(
            Outcome(
                kernel.reason,
                kernel.cycles,
                kernel.replica_reasons,
                kernel.replica_cycles,
                tuple(kernel.counts.ravel().tolist()),
                tuple(kernel.rng_state.ravel().tolist()),
            )
        )
    return outcomes, played


def register_writes(machine: BM1Machine, start: Start) -> dict[int, int]:
    """What a host writes before a frame: values by the registers' addresses."""
    parameters, places = machine.parameters, rtl.Places(machine.parameters)
    selects = np.broadcast_to(np.asarray(start.prior_address), (parameters.replicas,)).tolist()
    given = np.asarray(start.addresses).ravel().tolist()
    writes = {
        rtl.TARGET: start.target_count,
        rtl.MAX_CYCLES: start.max_cycles,
        rtl.MAX_CYCLES + 1: 0,
        rtl.RUN_UNTIL: start.run_until,
        rtl.RUN_UNTIL + 1: 0,
        rtl.BANK: start.bank,
        **{rtl.PRIOR_ADDRESSES + replica: address for replica, address in enumerate(selects)},
        **{places.inputs + at: address for at, address in enumerate(given)},
    }
    if parameters.prior_mode is PriorMode.WRITTEN:
        prior = machine.prior[0] if start.prior_codes is None else start.prior_codes
        codes = np.broadcast_to(prior, (parameters.replicas, parameters.lines)).ravel().tolist()
        writes |= {places.prior_codes + at: code for at, code in enumerate(codes)}
    return writes


def testbench(machine: BM1Machine, frames: Sequence[Frame]) -> str:
    """A bench that writes the registers as a host does, and prints what comes out."""
    parameters, places = machine.parameters, rtl.Places(machine.parameters)
    generators = parameters.columns * (1 if parameters.shared else parameters.lines)
    results, several = parameters.replicas * parameters.lines, parameters.replicas > 1
    steps = []
    for frame in frames:
        writes = register_writes(machine, frame.start)
        steps += [f"put({address}, {value});" for address, value in writes.items()]
        steps += [f"put({rtl.CONTROL}, 1);", "finish;"]
        for until, halted in frame.resumes:
            mask = sum(1 << replica for replica in halted)
            halt = [
                f"put({places.halt + word}, {mask >> rtl.WORD_BITS * word & 0xFFFFFFFF});"
                for word in range(places.end - places.halt)
            ]
            steps += [f"put({rtl.RUN_UNTIL}, {until});", *halt, f"put({rtl.CONTROL}, 2);", "finish;"]
        states = " ".join(f'$write(" %0d", dut.random_{at});' for at in range(generators))
        words = f"for (i = {places.outcomes}; i < {places.outcomes + rtl.OUTCOME_WORDS * parameters.replicas}; i = i + 1) begin"
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
    """What the text shows in Icarus Verilog."""
    machine = machine_of(case)
    text = folder / "bm1.v"
    text.write_text(rtl.verilog(machine, tables=True) + testbench(machine, frames))
    run(["iverilog", "-g2005", "-Wno-portbind", "-s", "bench", "-o", str(folder / "bm1.vvp"), str(text)])
    printed = run(["vvp", "-n", str(folder / "bm1.vvp")]).splitlines()
    parameters = case.parameters
    outcomes = []
    for line in printed:
        if not line[:1].isdigit():
            sys.exit(f"error: the simulation of {case.name} said {line!r}")
        reason, cycles, *rest = map(int, line.split())
        reasons, lengths = [StopReason(reason)], [cycles]
        if parameters.replicas > 1:
            words = [rest[at : at + rtl.OUTCOME_WORDS] for at in range(0, 4 * parameters.replicas, 4)]
            reasons = [StopReason(word[0]) for word in words]
            lengths = [word[2] + (word[3] << 32) for word in words]
            rest = rest[rtl.OUTCOME_WORDS * parameters.replicas :]
        results = parameters.replicas * parameters.lines
        outcomes.append(
            Outcome(
                StopReason(reason),
                cycles,
                tuple(reasons),
                tuple(lengths),
                tuple(rest[:results]),
                tuple(rest[results:]),
            )
        )
    return outcomes


def synthesised(case: Case, folder: Path) -> Alms:
    """What yosys makes of the text, its tables left out."""
    text = folder / "bm1.v"
    text.write_text(rtl.verilog(machine_of(case), tables=False))
    stat = folder / "stat.json"
    script = f"read_verilog {text}; synth_intel_alm -top bm1 -family cyclonev -noiopad -noclkbuf; tee -o {stat} stat -json"
    run(["yosys", "-q", "-p", script])
    cells = json.loads(stat.read_text())["modules"]["\\bm1"]["num_cells_by_type"]
    cells = {name.removeprefix("MISTRAL_"): count for name, count in cells.items()}
    return Alms(
        luts=sum(cells.get(f"ALUT{inputs}", 0) for inputs in range(2, 5)) + cells.get("NOT", 0),
        luts5=cells.get("ALUT5", 0),
        luts6=cells.get("ALUT6", 0),
        sums=cells.get("ALUT_ARITH", 0),
        registers=cells.get("FF", 0),
    )


def run(command: list[str]) -> str:
    """Run a tool and return what it printed; a failure ends the script with its last words."""
    try:
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        sys.exit(f"error: {command[0]} did not end within {LIMIT_S:.0f} s")
    except subprocess.CalledProcessError as error:
        sys.exit(f"error: {command[0]} failed: {(error.stderr or error.stdout).strip()[-400:]}")
    return done.stdout


def compare(cases: Sequence[Case], folder: Path, console: Console) -> tuple[int, int]:
    """Print estimate and synthesis of each machine side by side; passed and failed."""
    table = Table(title="Estimate / synthesis, tables left out", title_justify="left")
    for heading in ("machine", "ALUTs", "ALMs", "registers", "s"):
        table.add_column(heading, justify="left" if heading == "machine" else "right")
    passed = failed = 0
    for each in cases:
        began = time.monotonic()
        found = synthesised(each, folder)
        said = logic_of(each.parameters, whole_words=False)
        row, good = [], True
        for ours, theirs, tolerance in (
            (said.aluts, found.aluts, TOLERANCE),
            (said.alms, found.alms, TOLERANCE),
            (said.registers, found.registers, 0.0),
        ):
            good &= abs(ours - theirs) <= tolerance * theirs
            row.append(f"{ours:.0f} / {theirs:.0f} ({ours / theirs - 1:+.0%})")
        passed, failed = passed + good, failed + (not good)
        name = each.name + ("" if good else "  FAIL")
        table.add_row(name, *row, f"{time.monotonic() - began:.0f}")
        console.print(f"synthesised {each.name}", style="dim")
    Console(width=None if sys.stdout.isatty() else 140).print(table)
    return passed, failed


def calibrate(cases: Sequence[Case], folder: Path, console: Console) -> None:
    """Synthesise what the estimator is calibrated on, and print the costs that fit it best, beside those it has."""
    counted, aluts, alms = [], [], []
    for each in cases:
        found = synthesised(each, folder)
        said = logic_of(each.parameters, whole_words=False)
        bits = dict.fromkeys(Of, 0.0)
        for part in said.parts:
            for of, count in part.counts.items():
                bits[of] += count
        sums = sum(part.sums for part in said.parts)
        counted.append(list(bits.values()))
        aluts.append((found.aluts, sums))
        alms.append((found.alms, sums / 2))
        console.print(f"synthesised {each.name}", style="dim")
    luts, luts_error = fitted(np.array(counted), np.array(aluts))
    modules, alms_error = fitted(np.array(counted), np.array(alms))
    for of, lut, module in zip(Of, luts, modules, strict=True):
        print(
            f"{of:12} luts {lut:8.3f}  ({COSTS[of].luts:8.3f})   ALMs {module:8.3f}  ({COSTS[of].alms:8.3f})"
        )
    print(f"largest relative error of {len(cases)} machines: ALUTs {luts_error:.1%}, ALMs {alms_error:.1%}")


def fitted(
    counted: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    found: np.ndarray[tuple[int, int], np.dtype[np.float64]],
) -> tuple[list[float], float]:
    """Return costs of 0 or more with the least squares of relative errors, and the largest of these.

    Args:
        counted: float64[machines, kinds], what each machine has of each kind.
        found: float64[machines, 2], what a synthesis found and how much of that is carry chains, which are counted exactly.
    """
    whole, chains = found.T
    fixed = list(Of).index(Of.RESULT_BIT)
    costs = np.zeros(len(Of))
    costs[fixed] = COSTS[Of.RESULT_BIT].luts
    relative = counted / whole[:, np.newaxis]
    products, wanted = relative.T @ relative, relative.T @ ((whole - chains) / whole)
    for _ in range(FIT_ROUNDS):
        for at in range(len(costs)):
            if at != fixed:
                costs[at] += (wanted[at] - products[at] @ costs) / products[at, at]
                costs[at] = max(costs[at], 0.0)
    return costs.tolist(), float(np.abs((counted @ costs + chains) / whole - 1).max())


def main() -> int:
    """Simulate, then synthesise; exit 1 if anything differs."""
    parser = argparse.ArgumentParser(prog="scripts/verify resources", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--simulate-only", action="store_true", help="leave the synthesis out (no yosys needed)"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="synthesise the machines that the estimator is calibrated on, and fit its costs anew",
    )
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="machines whose description has this in it"
    )
    arguments = parser.parse_args()
    wanted = [] if arguments.calibrate else ["iverilog"]
    wanted += [] if arguments.simulate_only else ["yosys"]
    absent = [tool for tool in wanted if shutil.which(tool) is None]
    if absent:
        print(
            f"error: {' and '.join(absent)} not found; Debian: apt-get install iverilog yosys",
            file=sys.stderr,
        )
        return 2
    passed = failed = 0
    with tempfile.TemporaryDirectory(prefix="resources-rosbayes-") as where:
        folder = Path(where)
        if arguments.calibrate:
            calibrate(CALIBRATION, folder, Console(stderr=True))
            return 0
        for each in SIMULATED:
            if arguments.only not in each.name:
                continue
            ours, played = reference(machine_of(each), frames_of(each))
            theirs = simulated(each, played, folder)
            good = ours == theirs
            passed, failed = passed + good, failed + (not good)
            ends = ", ".join(f"{outcome.reason.name.lower()} {outcome.cycles}" for outcome in ours)
            print(
                f"{'ok  ' if good else 'FAIL'}  simulated as the reference: {each.name}: {ends}", flush=True
            )
        if not arguments.simulate_only:
            chosen = [each for each in SYNTHESISED if arguments.only in each.name]
            more = compare(chosen, folder, Console(stderr=True))
            passed, failed = passed + more[0], failed + more[1]
    print(f"{passed} passed, {failed} failed")
    if not passed + failed:
        print(f"error: no machine's description has {arguments.only!r} in it", file=sys.stderr)
    return 1 if failed or not passed else 0


if __name__ == "__main__":
    sys.exit(main())
