"""`bm1_parameters.vhd`: the VHDL package with all parameters of a BM1 (thesis 3.2)."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Final, Self

from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset
from machines.rng import POLYNOMIALS
from pcie_shim.programming_file import Image
from toolchain.bounded_files import read_bounded
from toolchain.deployment import Deployment
from toolchain.errors import BuildError
from toolchain.outputs.memories import column_name, generators, seed_width, seed_words
from toolchain.outputs.mif import printable

PARAMETERS_FILE: Final = "bm_arch/bm1_parameters.vhd"

_MOST_SEEDS: Final = 4096
"""Maximum number of seeds in the package; more are only in the memory file."""

_TYPES: Final = """\
  type rng_kind_t is (RNG_LFSR8, RNG_LFSR16, RNG_LFSR24, RNG_LFSR32, RNG_TABLE, RNG_IDEAL);
  type sensor_mode_t is (SENSOR_COLUMN, SENSOR_CELL, SENSOR_THRESHOLD);
  type natural_array_t is array (natural range <>) of natural;

  -- Lines of the model that a board holds, and what identifies its image.
  type partition_t is record
    lines       : positive;
    line_offset : natural;
    image_hash  : std_logic_vector(255 downto 0);
  end record partition_t;
  type partition_array_t is array (natural range <>) of partition_t;
"""


def parameters_vhd(deployment: Deployment, images: Sequence[Image]) -> str:
    """Return the text of the package, in VHDL-2008 and printable ASCII. Equal machines give equal bytes."""
    image = images[0]
    parameters = image.machine.parameters
    searched = ", ".join(f"{dimension.label} ({dimension.size})" for dimension in deployment.searched)
    return "".join(
        [
            f"-- Parameters of the Bayesian machine of the model {printable(deployment.name)}, VHDL-2008.\n",
            f"-- It searches {printable(searched)}; the first varies slowest from line to line.\n",
            "-- Written by 'toolchain build'; after an edit, 'toolchain regenerate images' updates the images.\n\n",
            "library ieee;\nuse ieee.std_logic_1164.all;\n\npackage bm1_parameters is\n\n",
            _TYPES,
            _section("The matrix: column 0 is the prior, columns 1 to SENSORS the known variables"),
            _constant("LINES", "positive", deployment.machine.lines, "of the whole model"),
            _constant("SENSORS", "natural", parameters.sensors),
            _constant("COLUMNS", "positive", parameters.columns),
            _constant("REPLICAS", "positive", parameters.replicas, "machines that share the generators"),
            _constant(
                "SENSOR_MODE",
                "sensor_mode_t",
                f"SENSOR_{parameters.sensor_mode.upper()}",
                "what the cells of a column get in a frame",
            ),
            _sensor_widths(deployment, parameters),
            _section("Resolutions, in bits"),
            _constant("PROB_BITS", "positive", parameters.prob_bits, "of a code in the probability tables"),
            _constant(
                "PRIOR_BITS",
                "natural",
                parameters.prior_bits,
                "of the prior's address; 0 for a prior of one row",
            ),
            _constant("COUNTER_BITS", "positive", parameters.counter_bits),
            _section("The prior"),
            _flag("PRIOR_WRITTEN", parameters.prior_mode is PriorMode.WRITTEN, "the host writes it"),
            _generator_constants(image),
            _seed_constants(image),
            _section(
                "When a machine stops: the host writes these values into registers, which hold 0 before"
            ),
            _constant("TARGET_COUNT", _vector(32), _hexadecimal(deployment.machine.target_count, 32)),
            _constant("MAX_CYCLES", _vector(64), _hexadecimal(deployment.machine.max_cycles, 64)),
            _section("The PCIe interface"),
            _constant("INTERFACE_SENSORS", "positive", image.interface_sensors, "inputs"),
            _constant("INTERFACE_RESULTS", "positive", image.interface_results, "outputs"),
            _constant("MAP_HASH", _vector(256), _hexadecimal(int(image.map_hash, 16), 256)),
            _section("The boards, and the lines of the model that each board has"),
            _constant("BOARDS", "positive", len(images)),
            _constant("MODEL_HASH", _vector(256), _hexadecimal(int(image.model_hash, 16), 256)),
            _partitions(images),
            _memory_files(images),
            "\nend package bm1_parameters;\n",
        ]
    )


def _section(title: str) -> str:
    return f"\n  -- {title}.\n"


def _constant(name: str, kind: str, value: object, comment: str = "") -> str:
    note = f"  -- {comment}" if comment else ""
    return f"  constant {name:17} : {kind} := {value};{note}\n"


def _flag(name: str, value: bool, comment: str) -> str:
    return _constant(name, "boolean", str(value).lower(), comment)


def _vector(bits: int) -> str:
    return f"std_logic_vector({bits - 1} downto 0)"


def _hexadecimal(value: int, bits: int) -> str:
    """Return a bit string literal: hexadecimal for a multiple of 4 bits, otherwise binary."""
    return f'x"{value:0{bits // 4}X}"' if bits % 4 == 0 else f'"{value:0{bits}b}"'


def _array(name: str, kind: str, rows: Iterable[tuple[int, str, str]], range_: str) -> str:
    """Return an array constant with one row per line: index, value, comment."""
    listed = list(rows)
    if not listed:
        return f"  constant {name:17} : {kind}({range_}) := (others => 0);\n"
    lines = [
        f"    {index} => {value}{',' if place < len(listed) - 1 else ''}{f'  -- {comment}' if comment else ''}\n"
        for place, (index, value, comment) in enumerate(listed)
    ]
    return f"  constant {name:17} : {kind}({range_}) := (\n{''.join(lines)}  );\n"


def _sensor_widths(deployment: Deployment, parameters: BM1Parameters) -> str:
    rows = [
        (
            column,
            str(bits),
            printable(variable.name) + (f", {variable.values} values" if parameters.has_tables else ""),
        )
        for column, (bits, variable) in enumerate(
            zip(parameters.sensor_bits, deployment.sensors, strict=True), start=1
        )
    ]
    title = (
        "\n  -- Address bits of every column; the top address of a column is a missing reading.\n"
        if parameters.has_tables
        else "\n  -- Bits of the codes that the cells of a column get; all ones is a missing reading.\n"
    )
    return title + _array("SENSOR_BITS", "natural_array_t", rows, f"1 to {parameters.sensors}")


def _generator_constants(image: Image) -> str:
    parameters, table = image.machine.parameters, image.machine.rng_table
    exponents = POLYNOMIALS.get(parameters.rng)
    text = _section("The random number generators") + _constant(
        "RNG_KIND", "rng_kind_t", f"RNG_{parameters.rng.upper()}"
    )
    width, taps = seed_width(image.machine), 0
    state, polynomial = "of a generator's state: an index of the table", "no LFSR"
    if exponents is not None:
        taps = sum(1 << (exponent - 1) for exponent in exponents)
        state = "of a generator's state"
        polynomial = " + ".join(f"x^{exponent}" for exponent in exponents) + " + 1"
    text += _constant("RNG_BITS", "positive", width, state)
    text += _constant("RNG_TAPS", _vector(width), _hexadecimal(taps, width), polynomial)
    length, what = (1, "no table") if table is None else (table.size, "numbers in the table")
    return (
        text
        + _constant("RNG_TABLE_LENGTH", "positive", length, what)
        + _flag(
            "RNG_SHARED", parameters.shared, "one per column, shared by its lines; otherwise one per cell"
        )
        + _constant("STEPS_PER_CLOCK", "positive", parameters.steps_per_clock)
        + _flag("RNG_RESET_BANK", parameters.rng_reset is RngReset.BANK, "a frame restarts the generators")
        + _constant("RNG_BANKS", "positive", parameters.rng_banks, "sets of seeds")
    )


def _seed_constants(image: Image) -> str:
    parameters = image.machine.parameters
    if parameters.rng is RngKind.IDEAL:
        return "\n  -- RNG_IDEAL exists only in emulation, and has no seeds.\n"
    width = seed_width(image.machine)
    text = "\n" + _constant("SEED_BITS", "positive", width)
    if not parameters.shared or parameters.rng_banks * generators(parameters) > _MOST_SEEDS:
        return text + "  -- The seeds are only in Memory_MIFs, because there are too many for this package.\n"
    kind = f"  type seed_array_t is array (natural range <>, natural range <>) of {_vector(width)};\n"
    rows = [
        f"    {bank} => ({', '.join(f'{column} => {_hexadecimal(int(seed), width)}' for column, seed in enumerate(row))})"
        for bank, row in enumerate(seed_words(image.machine))
    ]
    bounds = f"0 to {parameters.rng_banks - 1}, 0 to {parameters.columns - 1}"
    return (
        f"{text}  -- The seed of each bank and column, as in Memory_MIFs/rng_seeds.mif.\n{kind}"
        f"  constant RNG_SEEDS         : seed_array_t({bounds}) := (\n" + ",\n".join(rows) + "\n  );\n"
    )


def _partitions(images: Sequence[Image]) -> str:
    rows = [
        (
            board,
            (
                f"(lines => {image.machine.parameters.lines}, line_offset => {image.partition.line_offset}, "
                f"image_hash => {_hexadecimal(int(image.image_hash, 16), 256)})"
            ),
            "",
        )
        for board, image in enumerate(images)
    ]
    return _array("PARTITIONS", "partition_array_t", rows, f"0 to {len(images) - 1}")


def _memory_files(images: Sequence[Image]) -> str:
    sensors = images[0].machine.parameters.sensors
    sensors = sensors if images[0].machine.parameters.has_tables else 0
    columns = f", board<b>_{column_name(0, sensors, sensors).removeprefix('board0_')}" if sensors else ""
    seeds = "rng_seeds.mif" if images[0].machine.parameters.shared else "board<b>_rng_seeds.mif"
    return (
        f"\n  -- Contents of the memories, in Memory_MIFs: board<b>_prior.mif{columns} and so on, {seeds}.\n"
    )


_TOKEN: Final = re.compile(r'\n|--[^\n]*|\w*"[^"\n]*"|[\w.]+|:=|=>|[^\s]')
_MOST_BYTES: Final = 4 << 20
_FLAGS: Final = {"RNG_KIND": " --rng", "RNG_SHARED": " --per-cell", "RNG_BANKS": " --rng-banks"}
"""The flag of the build that changes each constant of the generators, for errors about a wrong constant."""
_IMAGE_HASH: Final = re.compile(r'(image_hash\s*=>\s*)x"[0-9a-f]{64}"')


@dataclass(frozen=True, slots=True)
class PackageTokens:
    """The tokens of a VHDL package of parameters, each with its line. Tokens are in lower case, and exclude comments.

    Hashes of images are left out, because they follow from the other tokens.
    """

    name: str
    """Path of the package's file, to be named in errors."""
    tokens: tuple[tuple[str, int], ...]

    @classmethod
    def of(cls, text: str, name: str = PARAMETERS_FILE) -> Self:
        """Return the tokens of a text."""
        found, line = [], 1
        for word in _TOKEN.findall(_IMAGE_HASH.sub(r"\1hash", text.lower())):
            if word == "\n":
                line += 1
            elif not word.startswith("--"):
                found.append((word, line))
        return cls(name, tuple(found))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the tokens of a file."""
        return cls.of(read_bounded(path, _MOST_BYTES, BuildError).decode("latin-1"), str(path))

    def value(self, constant: str) -> tuple[str, int]:
        """Return the value of a constant (its first token), and the token's line, or raise a BuildError."""
        words = [token for token, _ in self.tokens]
        for at in range(len(words) - 1):
            if words[at : at + 2] == ["constant", constant.lower()] and ":=" in words[at:]:
                return self.tokens[min(words.index(":=", at) + 1, len(words) - 1)]
        raise BuildError(
            f"there is no constant {constant}; expected the package of the build", path=self.name
        )

    def check_same(self, expected: Self) -> None:
        """Raise a BuildError for the first token that differs from `expected`."""
        constant, before = "the package", ""
        for found, due in zip_longest(self.tokens, expected.tokens, fillvalue=("the end", None)):
            if found[0] != due[0]:
                line = found[1] or self.tokens[-1][1]
                raise BuildError(
                    f"expected {due[0]} in {constant}, as memories and images have it, found {found[0]}; set it back, or "
                    f"build again with 'toolchain build{_FLAGS.get(constant, '')}'",
                    path=self.name,
                    line=line,
                )
            constant = found[0].upper() if before == "constant" else constant
            before = found[0]
