"""A BM1 as synthesizable Verilog, cell by cell as the thesis draws it: small machines, whose logic a synthesis counts.

One module per part: a generator a column (or a cell), a table, a comparator, an AND and a counter a cell or line,
and around them the interface's registers, the sequence of a frame and the readout. It computes what
`machines.reference` computes, to the bit; `scripts/verify resources` simulates and synthesises it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from machines.parameters import BM1Parameters, PriorMode, RngReset
from machines.rng import LFSRNumbers
from toolchain.errors import BuildError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from machines.bm1 import BM1Machine

MAX_CELLS: Final = 2048
"""Text of a larger machine helps nobody: a table a cell."""

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
PRIOR_ADDRESS: Final = 7
SENSORS: Final = 8
"""Address of the first sensor's register."""

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


def verilog(machine: BM1Machine, *, tables: bool) -> str:
    """Return a machine's text: module `bm1` and its parts.

    Args:
        machine: Which one; shared generators or one a cell, LFSRs only.
        tables: Whether the tables are there, for a simulation; else they are black boxes, and what is counted is
            everything but them.

    Raises:
        BuildError: Generators that are no LFSRs, or more than `MAX_CELLS` cells.
    """
    parameters = machine.parameters
    if parameters.rng.lfsr_bits is None:
        message = f"rng = {parameters.rng} has no logic here: use an LFSR"
        raise BuildError(message)
    if parameters.lines * parameters.columns > MAX_CELLS:
        message = (
            f"{parameters.lines} lines of {parameters.columns} columns are more than {MAX_CELLS} cells, too many to be "
            "written cell by cell"
        )
        raise BuildError(message)
    parts = [_PARTS, _generator(parameters), *_tables(machine, tables), *_top(machine)]
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
    """A memory for each cell, read in one clock (figures 2.1 and 2.2)."""
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


def _top(machine: BM1Machine) -> Iterator[str]:
    parameters = machine.parameters
    lines, columns = parameters.lines, parameters.columns
    width, counter = parameters.prob_bits, parameters.counter_bits
    address_bits = max((SENSORS + parameters.sensors + lines - 1).bit_length(), 1)
    bank_bits = max((parameters.rng_banks - 1).bit_length(), 1)
    last = CYCLE_BITS - 1
    yield f"""
module bm1 (
  input clk, input reset,
  input write, input [{address_bits - 1}:0] write_address, input [{WORD_BITS - 1}:0] write_data,
  input [{max((lines - 1).bit_length(), 1) - 1}:0] read_address, output reg [{counter - 1}:0] read_data,
  output reg [{last}:0] cycles, output reg [2:0] reason, output done);

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
    written = parameters.prior_mode is PriorMode.WRITTEN
    address_widths = [max(parameters.prior_bits, 1), *parameters.sensor_bits]
    for column, bits in enumerate(address_widths):
        yield f"  reg [{bits - 1}:0] address_{column};"
        place = PRIOR_ADDRESS if column == 0 else SENSORS + column - 1
        writes.append(f"{place}: address_{column} <= write_data[{bits - 1}:0];")
    if written:
        for line in range(lines):
            yield f"  reg [{width - 1}:0] prior_{line} = {machine.prior[0, line]};"
            writes.append(
                f"{SENSORS + parameters.sensors + line}: prior_{line} <= write_data[{width - 1}:0];"
            )
    joined = "\n      ".join(writes)
    yield f"  always @(posedge clk)\n    if (write) case (write_address)\n      {joined}\n      default: ;\n    endcase\n"
    yield from _generators(parameters, bank_bits)
    for line in range(lines):
        yield f"  wire [{columns - 1}:0] ones_{line}, dead_{line}; wire [{counter - 1}:0] count_{line};"
        for column in range(columns):
            code = f"code_{column}_{line}"
            number = column if parameters.shared else line * columns + column
            yield f"  wire [{width - 1}:0] {code};"
            if column == 0 and written:
                yield f"  assign {code} = prior_{line};"
            else:
                yield f"  bm1_table_{column}_{line} t_{column}_{line} (clk, address_{column}, {code});"
            yield (
                f"  bm1_cell #({width}) c_{column}_{line} "
                f"(random_{number}[{width - 1}:0], {code}, ones_{line}[{column}], dead_{line}[{column}]);"
            )
        yield (
            f"  bm1_counter #({counter}) n_{line} "
            f"(clk, clear, enable & (&ones_{line}), target, count_{line}, full[{line}]);"
        )
    yield from _frame(parameters)


def _generators(parameters: BM1Parameters, bank_bits: int) -> Iterator[str]:
    assert parameters.rng.lfsr_bits is not None  # noqa: S101 - verilog() has refused all else
    top = parameters.rng.lfsr_bits - 1
    count = parameters.columns * (1 if parameters.shared else parameters.lines)
    seeds = [LFSRNumbers(parameters).restart(bank).ravel().tolist() for bank in range(parameters.rng_banks)]
    yield f"  wire enable; wire [{parameters.lines - 1}:0] full;"
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


def _frame(parameters: BM1Parameters) -> Iterator[str]:
    """The frame's sequence, and the results: what the counters held when it ended."""
    lines, counter = parameters.lines, parameters.counter_bits
    hopeless = " & ".join(f"(|dead_{line})" for line in range(lines))
    captures = "\n      ".join(f"result[{line}] <= count_{line};" for line in range(lines))
    # The tables answer one clock after their addresses: `again` gives a frame that starts at once that clock.
    yield f"""
  wire overflow = |full;
  wire at_max = cycles == max_cycles;
  wire at_slice = cycles == run_until & (|run_until);
  wire hopeless = {hopeless};
  wire stop = overflow | at_max | at_slice;
  assign enable = state == RUN & ~stop;
  reg [{counter - 1}:0] result [0:{lines - 1}];
  always @(posedge clk) read_data <= result[read_address];
  always @(posedge clk)
    if (state == RUN & stop | state == LOAD & ~again & hopeless) begin
      {captures}
    end
  always @(posedge clk)
    if (reset) begin state <= IDLE; cycles <= 0; reason <= 0; again <= 0; end
    else case (state)
      IDLE: if (start) begin state <= LOAD; again <= 1; cycles <= 0; end else if (resume) state <= RUN;
      LOAD: begin
        again <= 0;
        if (~again) begin
          state <= hopeless ? IDLE : RUN;
          reason <= hopeless ? 4 : 0;
        end
      end
      RUN: begin
        if (stop) begin state <= IDLE; reason <= overflow ? 1 : at_max ? 2 : 3; end
        else cycles <= cycles + 1;
      end
      default: state <= IDLE;
    endcase
endmodule"""
