"""A BM1 as synthesizable Verilog, cell by cell as the thesis draws it: small machines, whose logic a synthesis counts.

One module per part: a generator a column (or a cell), a table, a comparator, an AND and a counter a cell or line,
and around them the interface's registers, the sequence of a frame and the readout. Replicas (thesis 4.4) are there as
often as there are machines, all but generators and sequence. It computes what `machines.reference` computes, to the
bit; `scripts/verify resources` simulates and synthesises it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from machines.bm1 import StopReason
from machines.parameters import BM1Parameters, PriorMode, RngReset, SensorMode
from machines.rng import LFSRNumbers
from toolchain.errors import BuildError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from machines.bm1 import BM1Machine

MAX_CELLS: Final = 2048
"""A larger machine's text is too long to be of use, with a table for each cell."""

CYCLE_BITS: Final = 64
"""Width of the cycle counter and of the limits it is compared with, as in the register map."""

WORD_BITS: Final = 32
"""Width of a register of the interface."""

CONTROL: Final = 0
"""Address of the control word: bit 0 starts a frame, bit 1 resumes it."""
TARGET: Final = 1
MAX_CYCLES: Final = 2
RUN_UNTIL: Final = 4
BANK: Final = 6
PRIOR_ADDRESSES: Final = 7
"""Address of the first replica's prior address; the others' follow."""

OUTCOME_WORDS: Final = 4
"""Words that say of a replica why it stands still, and how many cycles it ran."""

_PARTS: Final = """\
// r < code, or always for the all-ones code; dead says that the code is 0
module bm1_cell #(parameter W = 8) (input [W-1:0] r, input [W-1:0] code, output one, output dead);
  assign one = (r < code) | (&code);
  assign dead = ~(|code);
endmodule

module bm1_counter #(parameter N = 8) (
  input clk, input clear, input add, input [N-1:0] target, output reg [N-1:0] count, output full);
  assign full = count == target;
  always @(posedge clk)
    if (clear) count <= 0;
    else count <= count + add;
endmodule
"""


@dataclass(frozen=True, slots=True)
class Places:
    """Where the registers of a machine's inputs are, after those that all machines have: a word each.

    As in the register map each replica's inputs are those of column 1, then of column 2 and so on: one, or one a line.
    """

    parameters: BM1Parameters

    @property
    def inputs_a_column(self) -> int:
        return 1 if self.parameters.sensor_mode is SensorMode.COLUMN else self.parameters.lines

    @property
    def inputs(self) -> int:
        return PRIOR_ADDRESSES + self.parameters.replicas

    @property
    def prior_codes(self) -> int:
        return self.inputs + self.parameters.replicas * self.parameters.sensors * self.inputs_a_column

    @property
    def halt(self) -> int:
        """The first word of what replicas a resume leaves where they stand; there are none of a single machine."""
        written = self.parameters.prior_mode is PriorMode.WRITTEN
        return self.prior_codes + (self.parameters.replicas * self.parameters.lines if written else 0)

    @property
    def end(self) -> int:
        """The first address that is none."""
        several = self.parameters.replicas > 1
        return self.halt + (math.ceil(self.parameters.replicas / WORD_BITS) if several else 0)

    @property
    def outcomes(self) -> int:
        """Where replicas' outcomes are read: four words each, reason, 0 and cycles, as in the register map."""
        words = self.parameters.replicas * max(self.parameters.lines, OUTCOME_WORDS)
        return 1 << (words - 1).bit_length()


def verilog(machine: BM1Machine, *, tables: bool) -> str:
    """Return a machine's text, module `bm1` and its parts; tables are black boxes unless they are asked for."""
    parameters = machine.parameters
    if parameters.rng.lfsr_bits is None:
        raise BuildError(f"rng = {parameters.rng} has no logic here: use an LFSR")
    if parameters.replicas * parameters.lines * parameters.columns > MAX_CELLS:
        times = f", {parameters.replicas} times," if parameters.replicas > 1 else ""
        raise BuildError(
            f"{parameters.lines} lines of {parameters.columns} columns{times} are more than {MAX_CELLS} cells, too many to "
            "be written cell by cell"
        )
    parts = [
        _PARTS,
        _generator(parameters),
        *_tables(machine, tables),
        *_interface(machine),
        *_generators(parameters),
    ]
    for replica in range(parameters.replicas):
        parts += _matrix(parameters, replica)
    parts += _frame(parameters) if parameters.replicas == 1 else _frame_of_replicas(parameters)
    return "\n".join(parts)


def _generator(parameters: BM1Parameters) -> str:
    """One LFSR: it takes a seed, or makes `steps_per_clock` steps at once."""
    from machines.rng import LFSR

    lfsr = LFSR(parameters.rng)
    top = lfsr.bits - 1
    taps = [bit for bit in range(lfsr.bits) if lfsr.taps >> bit & 1]
    lines = [
        f"module bm1_generator (input clk, input load, input step, input [{top}:0] seed, output reg [{top}:0] state);",
        f"  wire [{top}:0] s0 = state;",
    ]
    for step in range(parameters.steps_per_clock):
        parity = " ^ ".join(f"s{step}[{tap}]" for tap in taps)
        lines.append(f"  wire [{top}:0] s{step + 1} = {{s{step}[{top - 1}:0], {parity}}};")
    lines += [
        "  always @(posedge clk)",
        "    if (load) state <= seed;",
        f"    else if (step) state <= s{parameters.steps_per_clock};",
        "endmodule",
        "",
    ]
    return "\n".join(lines)


def _tables(machine: BM1Machine, real: bool) -> Iterator[str]:
    """A memory for each cell, read in one clock (figures 2.1 and 2.2); cells that are given codes have none."""
    parameters = machine.parameters
    width = parameters.prob_bits
    written = parameters.prior_mode is PriorMode.WRITTEN
    for column, table in enumerate((machine.prior, *machine.tables)):
        if column == 0 and written:
            continue
        bits = max(len(table).bit_length() - 1, 1)
        ports = f"input clk, input [{bits - 1}:0] address, output reg [{width - 1}:0] code"
        for line in range(parameters.lines):
            name = f"bm1_table_{column}_{line}"
            if not real:
                yield f"(* blackbox *) module {name} ({ports}); endmodule"
                continue
            rows = [f"    {row}: code <= {table[row, line]};" for row in range(len(table))]
            body = "\n".join([*rows, "    default: code <= 0;"])
            yield f"module {name} ({ports});\n  always @(posedge clk) case (address)\n{body}\n  endcase\nendmodule"


def _interface(machine: BM1Machine) -> Iterator[str]:
    """The module's ports and the registers that the host writes."""
    parameters = machine.parameters
    counter = parameters.counter_bits
    places = Places(parameters)
    address_bits = (places.end - 1).bit_length()
    bank_bits = _bank_bits(parameters)
    last = CYCLE_BITS - 1
    several = parameters.replicas > 1
    # replicas' cycles and reasons are read as words; a single machine's are ports, as registers of their own
    readable = places.outcomes + OUTCOME_WORDS * parameters.replicas if several else parameters.lines
    read_bits = max((readable - 1).bit_length(), 1)
    data_bits = WORD_BITS if several else counter
    yield f"""
module bm1 (
  input clk, input reset,
  input write, input [{address_bits - 1}:0] write_address, input [{WORD_BITS - 1}:0] write_data,
  input [{read_bits - 1}:0] read_address, output reg [{data_bits - 1}:0] read_data,
  output reg [{last}:0] cycles, output {"" if several else "reg "}[2:0] reason, output done);

  localparam IDLE = 0, LOAD = 1, RUN = 2;
  reg [1:0] state;
  reg [{counter - 1}:0] target;
  reg [{last}:0] max_cycles, run_until;
  reg [{bank_bits - 1}:0] bank;
  reg again;
  wire start = write & write_address == {CONTROL} & write_data[0];
  wire resume = write & write_address == {CONTROL} & write_data[1];
  wire clear = reset | state == LOAD;
  assign done = state == IDLE;
"""
    writes = [
        f"{TARGET}: target <= write_data[{counter - 1}:0];",
        f"{MAX_CYCLES}: max_cycles[{WORD_BITS - 1}:0] <= write_data;",
        f"{MAX_CYCLES + 1}: max_cycles[{last}:{WORD_BITS}] <= write_data;",
        f"{RUN_UNTIL}: run_until[{WORD_BITS - 1}:0] <= write_data;",
        f"{RUN_UNTIL + 1}: run_until[{last}:{WORD_BITS}] <= write_data;",
        f"{BANK}: bank <= write_data[{bank_bits - 1}:0];",
    ]
    for declaration, write in _inputs_of_frames(machine, places):
        yield declaration
        writes.append(write)
    if several:
        yield f"  reg [{parameters.replicas - 1}:0] halt;"
        for word in range(places.end - places.halt):
            low = word * WORD_BITS
            count = min(WORD_BITS, parameters.replicas - low)
            writes.append(
                f"{places.halt + word}: halt[{low + count - 1}:{low}] <= write_data[{count - 1}:0];"
            )
    joined = "\n      ".join(writes)
    yield f"  always @(posedge clk)\n    if (write) case (write_address)\n      {joined}\n      default: ;\n    endcase\n"


def _inputs_of_frames(machine: BM1Machine, places: Places) -> Iterator[tuple[str, str]]:
    """The registers of what changes with the frames, addresses and codes: each one's declaration, and what writes it."""
    parameters = machine.parameters
    registers = [
        (f"address_{replica}_0", max(parameters.prior_bits, 1), PRIOR_ADDRESSES + replica)
        for replica in range(parameters.replicas)
    ]
    place = places.inputs
    for replica in range(parameters.replicas):
        for column, bits in enumerate(parameters.sensor_bits, start=1):
            for line in range(places.inputs_a_column):
                registers.append((_input(parameters, replica, column, line), bits, place))
                place += 1
    for name, bits, place in registers:
        yield f"  reg [{bits - 1}:0] {name};", f"{place}: {name} <= write_data[{bits - 1}:0];"
    if parameters.prior_mode is PriorMode.WRITTEN:
        width = parameters.prob_bits
        for number in range(parameters.replicas * parameters.lines):
            replica, line = divmod(number, parameters.lines)
            name = f"prior_{replica}_{line}"
            yield (
                f"  reg [{width - 1}:0] {name} = {machine.prior[0, line]};",
                f"{places.prior_codes + number}: {name} <= write_data[{width - 1}:0];",
            )


def _bank_bits(parameters: BM1Parameters) -> int:
    return max((parameters.rng_banks - 1).bit_length(), 1)


def _input(parameters: BM1Parameters, replica: int, column: int, line: int) -> str:
    """The register that a cell looks at: its column's, or its own."""
    if column == 0 or parameters.sensor_mode is SensorMode.COLUMN:
        return f"address_{replica}_{column}"
    return f"address_{replica}_{column}_{line}"


def _generators(parameters: BM1Parameters) -> Iterator[str]:
    assert parameters.rng.lfsr_bits is not None
    top = parameters.rng.lfsr_bits - 1
    bank_bits = _bank_bits(parameters)
    count = parameters.columns * (1 if parameters.shared else parameters.lines)
    seeds = [LFSRNumbers(parameters).restart(bank).ravel().tolist() for bank in range(parameters.rng_banks)]
    yield "  wire enable;"
    free = parameters.rng_reset is RngReset.FREE
    load = "reset" if free else "clear"
    for number in range(count):
        yield f"  wire [{top}:0] random_{number};"
        if free:
            yield f"  wire [{top}:0] seed_{number} = {top + 1}'d{seeds[0][number]};"
        else:
            yield f"  reg [{top}:0] seed_{number};"
            cases = " ".join(
                f"{bank}: seed_{number} = {top + 1}'d{seeds[bank][number]};" for bank in range(len(seeds))
            )
            chosen = f"reset ? {bank_bits}'d0 : bank"
            yield f"  always @* case ({chosen}) {cases} default: seed_{number} = {top + 1}'d{seeds[0][number]}; endcase"
        yield f"  bm1_generator g_{number} (clk, {load}, enable, seed_{number}, random_{number});"


def _matrix(parameters: BM1Parameters, replica: int) -> Iterator[str]:
    """One replica's tables, cells, lines and counters."""
    lines, columns = parameters.lines, parameters.columns
    width, counter = parameters.prob_bits, parameters.counter_bits
    several = parameters.replicas > 1
    yield f"  wire enable_{replica}; wire [{lines - 1}:0] full_{replica};"
    for line in range(lines):
        at = f"{replica}_{line}"
        yield f"  wire [{columns - 1}:0] ones_{at}, dead_{at}; wire [{counter - 1}:0] count_{at};"
        for column in range(columns):
            cell = f"{replica}_{column}_{line}"
            number = column if parameters.shared else line * columns + column
            given = _input(parameters, replica, column, line)
            yield f"  wire [{width - 1}:0] code_{cell};"
            if column == 0 and parameters.prior_mode is PriorMode.WRITTEN:
                yield f"  assign code_{cell} = prior_{at};"
            elif column and not parameters.has_tables:
                yield f"  assign code_{cell} = {given};"
            else:
                yield f"  bm1_table_{column}_{line} t_{cell} (clk, {given}, code_{cell});"
            yield (
                f"  bm1_cell #({width}) c_{cell} "
                f"(random_{number}[{width - 1}:0], code_{cell}, ones_{at}[{column}], dead_{at}[{column}]);"
            )
        yield (
            f"  bm1_counter #({counter}) n_{at} "
            f"(clk, clear, enable_{replica} & (&ones_{at}), target, count_{at}, full_{replica}[{line}]);"
        )
    yield f"  wire overflow_{replica} = |full_{replica};"
    yield f"  wire hopeless_{replica} = {' & '.join(f'(|dead_{replica}_{line})' for line in range(lines))};"
    if several:
        yield f"  reg running_{replica}, halted_{replica}; reg [2:0] reason_{replica}; reg [{CYCLE_BITS - 1}:0] cycles_{replica};"


_LIMITS: Final = """
  wire at_max = cycles == max_cycles;
  wire at_slice = cycles == run_until & (|run_until);
"""


def _frame(parameters: BM1Parameters) -> Iterator[str]:
    """A single machine's sequence of a frame, and the results: what the counters held when it ended."""
    lines, counter = parameters.lines, parameters.counter_bits
    captures = "\n      ".join(f"result[{line}] <= count_0_{line};" for line in range(lines))
    # The tables answer one clock after their addresses: `again` gives a frame that starts at once that clock.
    yield f"""{_LIMITS}
  wire stop = overflow_0 | at_max | at_slice;
  assign enable = state == RUN & ~stop;
  assign enable_0 = enable;
  reg [{counter - 1}:0] result [0:{lines - 1}];
  always @(posedge clk) read_data <= result[read_address];
  always @(posedge clk)
    if (state == RUN & stop | state == LOAD & ~again & hopeless_0) begin
      {captures}
    end
  always @(posedge clk)
    if (reset) begin state <= IDLE; cycles <= 0; reason <= {StopReason.NONE}; again <= 0; end
    else case (state)
      IDLE: if (start) begin state <= LOAD; again <= 1; cycles <= 0; end else if (resume) state <= RUN;
      LOAD: begin
        again <= 0;
        if (~again) begin
          state <= hopeless_0 ? IDLE : RUN;
          reason <= hopeless_0 ? {StopReason.IMPOSSIBLE} : {StopReason.NONE};
        end
      end
      RUN: begin
        if (stop) begin
          state <= IDLE;
          reason <= overflow_0 ? {StopReason.OVERFLOW} : at_max ? {StopReason.MAX_CYCLES} : {StopReason.SLICE};
        end
        else cycles <= cycles + 1;
      end
      default: state <= IDLE;
    endcase
endmodule"""


def _end_of_replica(replica: int, lines: int) -> str:
    """Why and when a replica stops: its counts go into its part of `result`, its cycles and its reason are kept."""
    captures = "\n      ".join(
        f"result[{replica * lines + line}] <= count_{replica}_{line};" for line in range(lines)
    )
    return f"""
  wire stop_{replica} = overflow_{replica} | at_max | at_slice;
  assign enable_{replica} = state == RUN & running_{replica} & ~stop_{replica};
  wire over_{replica} = state == RUN & running_{replica} & stop_{replica} | state == LOAD & ~again & hopeless_{replica};
  wire ready_{replica} = reason_{replica} == {StopReason.SLICE} & ~halted_{replica};
  always @(posedge clk)
    if (over_{replica}) begin
      cycles_{replica} <= cycles;
      {captures}
    end
  always @(posedge clk)
    if (reset) begin running_{replica} <= 0; halted_{replica} <= 0; reason_{replica} <= {StopReason.NONE}; end
    else begin
      if (start & done) halted_{replica} <= 0;
      if (resume & done) begin
        halted_{replica} <= halted_{replica} | halt[{replica}];
        running_{replica} <= ready_{replica} & ~halt[{replica}];
      end
      if (state == LOAD & ~again) begin
        running_{replica} <= ~hopeless_{replica};
        reason_{replica} <= hopeless_{replica} ? {StopReason.IMPOSSIBLE} : {StopReason.NONE};
      end
      if (state == RUN & running_{replica} & stop_{replica}) begin
        running_{replica} <= 0;
        reason_{replica} <= overflow_{replica} ? {StopReason.OVERFLOW} : at_max ? {StopReason.MAX_CYCLES} : {StopReason.SLICE};
      end
    end"""


def _frame_of_replicas(parameters: BM1Parameters) -> Iterator[str]:
    """Replicas' sequence of a frame: each stops by itself, and its counts, cycles and reason are kept from then on.

    All that run have run equally long, so there is one cycle counter; generators step while any runs.
    """
    replicas = range(parameters.replicas)

    def all_of(name: str, operator: str) -> str:
        return f" {operator} ".join(f"{name}_{replica}" for replica in replicas)

    yield _LIMITS
    yield f"  reg [{parameters.counter_bits - 1}:0] result [0:{parameters.replicas * parameters.lines - 1}];"
    for replica in replicas:
        yield _end_of_replica(replica, parameters.lines)
    words = []
    for replica in replicas:
        words += [
            f"{OUTCOME_WORDS * replica}: outcome = reason_{replica};",
            f"{OUTCOME_WORDS * replica + 2}: outcome = cycles_{replica}[{WORD_BITS - 1}:0];",
            f"{OUTCOME_WORDS * replica + 3}: outcome = cycles_{replica}[{CYCLE_BITS - 1}:{WORD_BITS}];",
        ]
    outcomes = Places(parameters).outcomes
    place = (OUTCOME_WORDS * parameters.replicas - 1).bit_length()
    joined = "\n      ".join(words)
    seen = {
        reason: " | ".join(f"reason_{replica} == {reason}" for replica in replicas)
        for reason in (StopReason.OVERFLOW, StopReason.MAX_CYCLES, StopReason.IMPOSSIBLE)
    }
    chosen = " : ".join(f"({any_of}) ? {reason}" for reason, any_of in seen.items())
    # the tables answer one clock after their addresses: `again`, as above
    yield f"""
  assign enable = {all_of("enable", "|")};
  assign reason = ({all_of("ready", "|")}) ? {StopReason.SLICE} : {chosen} : {StopReason.NONE};
  reg [{WORD_BITS - 1}:0] outcome;
  always @* case (read_address[{place - 1}:0])
      {joined}
      default: outcome = 0;
    endcase
  always @(posedge clk) read_data <= read_address >= {outcomes} ? outcome : result[read_address];
  always @(posedge clk)
    if (reset) begin state <= IDLE; cycles <= 0; again <= 0; end
    else case (state)
      IDLE: if (start) begin state <= LOAD; again <= 1; cycles <= 0; end else if (resume) state <= RUN;
      LOAD: begin
        again <= 0;
        if (~again) state <= {all_of("hopeless", "&")} ? IDLE : RUN;
      end
      RUN: if (enable) cycles <= cycles + 1; else state <= IDLE;
      default: state <= IDLE;
    endcase
endmodule"""
