"""Mutants of the hardware: small mistakes in the VHDL, each of which a check must detect."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdl.test.project import HDL
from hdl.test.verification import Check, formal, units


@dataclass(frozen=True)
class Mutant:
    """One mistake in the VHDL.

    Attributes:
        name: Description of the mistake.
        file: Name of the VHDL file.
        right: Correct text. The file contains this text exactly once.
        wrong: Text that replaces `right` in the file.
    """

    name: str
    file: str
    right: str
    wrong: str


MUTANTS: Final = (
    Mutant(
        "a cell compares with <= instead of <",
        "bm1_stochastic_bitstream_generator.vhd",
        "unsigned(random_i) < unsigned(code_i)",
        "unsigned(random_i) <= unsigned(code_i)",
    ),
    Mutant(
        "the all-ones code is not always 1",
        "bm1_stochastic_bitstream_generator.vhd",
        " or (and code_i) = '1'",
        "",
    ),
    Mutant(
        "the LFSR has an additional tap",
        "bm1_lfsr.vhd",
        "(xor (following and TAPS))",
        "((xor (following and TAPS)) xor following(0))",
    ),
    Mutant(
        "the LFSR shifts right",
        "bm1_lfsr.vhd",
        "following(STATE_BITS - 2 downto 0) & (xor (following and TAPS))",
        "(xor (following and TAPS)) & following(STATE_BITS - 1 downto 1)",
    ),
    Mutant(
        "one step too many per clock",
        "bm1_lfsr.vhd",
        "for step in 1 to STEPS loop",
        "for step in 0 to STEPS loop",
    ),
    Mutant(
        "the ring of random numbers is longer by one",
        "bm1_table_player.vhd",
        "if (sum >= LENGTH) then",
        "if (sum > LENGTH) then",
    ),
    Mutant(
        "the seeds are off by one",
        "bm1_generators.vhd",
        "remaining <= to_unsigned(GENERATORS, INDEX_BITS);",
        "remaining <= to_unsigned(GENERATORS - 1, INDEX_BITS);",
    ),
    Mutant(
        "a reset keeps the bank",
        "bm1_core.vhd",
        "bank_i when restart_bank = '1' else",
        "bank_i when true else",
    ),
    Mutant(
        "the last increment is lost",
        "bm1_control.vhd",
        "at_max   <= '1' when cycles = max_cycles else",
        "at_max   <= '1' when cycles + 1 = max_cycles else",
    ),
    Mutant(
        "a limit takes precedence over an overflow",
        "bm1_control.vhd",
        "if (overflow_i(r) = '1') then\n            reasons(r) <= REASON_OVERFLOW;\n          elsif (at_max = '1') then\n"
        "            reasons(r) <= REASON_MAX_CYCLES;",
        "if (at_max = '1') then\n            reasons(r) <= REASON_MAX_CYCLES;\n          elsif (overflow_i(r) = '1') then\n"
        "            reasons(r) <= REASON_OVERFLOW;",
    ),
    Mutant(
        "the end of a slice takes precedence over the last cycle",
        "bm1_control.vhd",
        "elsif (at_max = '1') then",
        "elsif (at_max = '1' and at_slice = '0') then",
    ),
    Mutant(
        "the generators take one step fewer",
        "bm1_control.vhd",
        "step_o         <= or enable;",
        "step_o         <= '1' when (or enable) = '1' and cycles + 1 /= max_cycles else '0';",
    ),
    Mutant(
        "a stopped replica keeps counting",
        "bm1_control.vhd",
        "state = running and going(r) = '1' and (overflow_i(r) or at_max or at_slice) = '0' else",
        "state = running and going(r) = '1' and ((and overflow_i) or at_max or at_slice) = '0' else",
    ),
    Mutant(
        "a halted replica is resumed",
        "bm1_control.vhd",
        "going(r)  <= ready(r) and not halt_i(r);",
        "going(r)  <= ready(r);",
    ),
    Mutant(
        "a halted replica forgets that it is halted",
        "bm1_control.vhd",
        "halted(r) <= halted(r) or halt_i(r);",
        "halted(r) <= halt_i(r);",
    ),
    Mutant(
        "an impossible frame runs", "bm1_control.vhd", "going(r) <= not impossible_i(r);", "going(r) <= '1';"
    ),
    Mutant(
        "one line that cannot count makes a frame impossible",
        "bm1_matrix.vhd",
        "impossible_o <= and never;",
        "impossible_o <= or never;",
    ),
    Mutant(
        "only the first line overflows",
        "bm1_matrix.vhd",
        "overflow_o   <= or full;",
        "overflow_o   <= full(0);",
    ),
    Mutant(
        "a start does not clear the counters",
        "bm1_control.vhd",
        "clear_o        <= rst_i or reset_i or start;",
        "clear_o        <= rst_i or reset_i;",
    ),
    Mutant("free generators restart", "bm1_control.vhd", "(start = '1' and RESET_BANK)", "(start = '1')"),
    Mutant(
        "a frame follows the target that is written after its start",
        "bm1_control.vhd",
        "target_o       <= target;",
        "target_o       <= target_i;",
    ),
    Mutant(
        "a latched high word is dropped",
        "bm_register_block.vhd",
        "cycles_held <= '1';",
        "cycles_held <= '0';",
    ),
    Mutant(
        "DONE is counted from 0",
        "bm1_guard.vhd",
        "due <= to_unsigned(1, 32) when (and done_i) = '1' else",
        "due <= to_unsigned(0, 32) when (and done_i) = '1' else",
    ),
    Mutant(
        "writes are accepted while the machine runs",
        "bm1_guard.vhd",
        "elsif (running_i = '1'\n",
        "elsif (running_i = '1' and unsigned(address_i) /= BANK_ADDRESS\n",
    ),
    Mutant(
        "one word too many can be read",
        "bm1_guard.vhd",
        "address >= first and address < first + 4 * words",
        "address >= first and address <= first + 4 * words",
    ),
    Mutant(
        "a code that is too large is accepted",
        "bm1_words.vhd",
        "too_large <= or data(31 downto WIDTH);",
        "too_large <= or data(15 downto WIDTH);",
    ),
    Mutant(
        "a doorbell of 0 is read back",
        "bm1_registers.vhd",
        "and (rings = '1'\n",
        "and (rings = '1' or true\n",
    ),
    Mutant(
        "a reset clears DONE",
        "bm1_registers.vhd",
        "if (rst_i = '1') then\n        number      <= (others => '0');",
        "if (rst_i = '1' or control(CONTROL_RESET_LOW) = '1') then\n        number      <= (others => '0');",
    ),
    Mutant(
        "a reset keeps the error",
        "bm1_registers.vhd",
        "if (control(CONTROL_RESET_LOW) = '1') then\n          error_code <= (others => '0');",
        "if (control(CONTROL_RESET_LOW) = '1') then\n          error_code <= error_code;",
    ),
    Mutant(
        "the interrupt cannot be disabled",
        "bm1_registers.vhd",
        "irq_o        <= done_i and control(CONTROL_INTERRUPT_ENABLE_LOW);",
        "irq_o        <= done_i;",
    ),
    Mutant(
        "a refused access is answered as if it were accepted",
        "bm1_axi.vhd",
        "if (refused_i = '1') then",
        "if (refused_i = '1' and state = BUSY_READ) then",
    ),
    Mutant(
        "replicas' counts in the wrong order",
        "bm1_readout.vhd",
        "counts(c) <= counts_i((c + 1) * COUNTER_BITS - 1 downto c * COUNTER_BITS);",
        "counts(RESULTS - 1 - c) <= counts_i((c + 1) * COUNTER_BITS - 1 downto c * COUNTER_BITS);",
    ),
)

_UNIT_FILES: Final = ("bm_register_block.vhd", "bm1_guard.vhd")
_SESSIONS: Final = (8, 25, 2, 15, 23, 17, 3, 14, 6, 9, 22, 0, 1, 11, 12, 16, 18, 19)
"""Seeds of sessions on small machines of every kind."""


def _checks(mutant: Mutant) -> list[Check]:
    """Return the checks, beginning with those that most likely detect the mutant."""
    machines = [Check("session", str(seed)) for seed in _SESSIONS]
    proofs = [check for check in formal() if check.what != "every start ends"]
    if mutant.file in _UNIT_FILES:
        return [*units(), *machines, *proofs]
    return [*machines, *proofs]


def caught_by(mutant: Mutant) -> tuple[Check, str] | None:
    """Return the first check that detects a mutant, and why the check fails, or None if no check detects the mutant.

    Raises:
        HardwareToolError: A tool refuses the mutant. A refusal does not count as a detection.
        ValueError: The mutant's file does not contain the text to replace exactly once.
    """
    with tempfile.TemporaryDirectory(prefix="mutant-rosbayes-") as where:
        hdl = Path(where) / "hdl"
        shutil.copytree(HDL, hdl, ignore=shutil.ignore_patterns("__pycache__"))
        path = hdl / mutant.file
        text = path.read_text()
        if text.count(mutant.right) != 1:
            message = f"{mutant.file} does not have the text of the mutant '{mutant.name}' exactly once"
            raise ValueError(message)
        path.write_text(text.replace(mutant.right, mutant.wrong))
        for check in _checks(mutant):
            why = check.failure(hdl)
            if why is not None:
                return check, why
    return None
