"""Every memory of a machine as a MIF, read back by srec_cat, and the parameters, read by GHDL."""

import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from machines.parameters import PriorMode, RngKind, RngReset
from machines.rng import random_numbers
from pcie_shim.programming_file import read_image
from tests.patience import PROCESS_PATIENCE
from tests.toolchain.running import build_model, contents
from toolchain.deployment import load_deployment
from toolchain.models.conditional import normal
from toolchain.models.model import Known, Model, PriorSelect, cell_centres, interval
from toolchain.outputs.mif import random_table, read_mif

KINDS = [
    {},
    {"prob_bits": 5, "partitions": 2, "rng": RngKind.LFSR8, "rng_banks": 3},
    {"prob_bits": 12, "partitions": 4, "shared": False, "rng": RngKind.LFSR24},
    {"prob_bits": 16, "partitions": 3, "counter_bits": 32, "rng_reset": RngReset.FREE},
    {"rng": RngKind.TABLE, "rng_banks": 2, "prior_mode": PriorMode.WRITTEN},
    {"rng": RngKind.TABLE, "shared": False, "partitions": 2, "prob_bits": 3, "steps_per_clock": 5},
]


def model(*, select=False, lines=7):
    place = interval("x", 0, 10, cells=lines)
    (x,) = cell_centres(place)
    rows = np.vstack([np.full(lines, 1 / lines), np.arange(lines) / np.arange(lines).sum(), np.eye(lines)[0]])
    return Model(
        name='tëst "quoted"; name --',
        searched=(place,),
        known=(
            normal("D %1;", mean=x, sigma=1.0, values=15, floor=0.05),
            Known(name="door", table=np.array([x / 10, 1 - x / 10])),
        ),
        prior_select=PriorSelect(name="room", table=rows) if select else None,
    )


def build(folder, *, select=False, lines=7, **changes):
    select = select and changes.get("prior_mode") is not PriorMode.WRITTEN
    build_model(model(select=select, lines=lines), folder, **changes)
    deployment = load_deployment(folder)
    return [read_image(deployment.image_path(board)) for board in range(len(deployment.boards))]


def test_the_made_table_has_every_number_equally_often():
    for bits in (1, 8, 16):
        assert np.bincount(random_table(bits)).tolist() == [2 ** (16 - bits)] * 2**bits
    assert not np.array_equal(random_table(16), np.arange(65536))


SLICE_DIGITS = 15
"""Hexadecimal digits of 60 bits: srec_cat holds no words of more than 62."""


def read_by_srec_cat(path, folder):
    """The width of a MIF and its words, as srec_cat reads them.

    A wide one is cut, as text, into files of 15 digits a word each; nothing of this project's reader has a part in it.
    """
    text = path.read_text("ascii")
    width = int(re.search(r"^WIDTH=(\d+);$", text, re.MULTILINE)[1])
    digits = -(-width // 4)
    words = None
    for low in range(0, digits, SLICE_DIGITS):
        bits = min(4 * SLICE_DIGITS, width - 4 * low)
        high, count = digits - low, -(-bits // 4)
        narrow = re.sub(
            rf"^([0-9A-F]+) : [0-9A-F]{{{high - count}}}([0-9A-F]{{{count}}})[0-9A-F]{{{low}}};$",
            r"\1 : \2;",
            text.replace(f"WIDTH={width};", f"WIDTH={bits};"),
            flags=re.MULTILINE,
        )
        (folder / "slice.mif").write_text(narrow, "ascii")
        command = ["srec_cat", folder / "slice.mif", "-mif", "-o", folder / "words.bin", "-binary"]
        subprocess.run(command, check=True, timeout=PROCESS_PATIENCE, capture_output=True)
        data, size = (folder / "words.bin").read_bytes(), -(-bits // 8)
        found = [int.from_bytes(data[place : place + size], "little") for place in range(0, len(data), size)]
        words = [word | part << 4 * low for word, part in zip(words or [0] * len(found), found, strict=True)]
    return width, words


def read_by_toolchain(path, _):
    mif = read_mif(path)
    return mif.width, list(mif.words)


def words_of(machine, codes):
    """The words that the table in an image must have become: line 0 in the lowest bits."""
    bits = machine.parameters.prob_bits
    return [sum(code << bits * line for line, code in enumerate(row)) for row in codes.tolist()]


CHANGES = [*KINDS, {"lines": 400}, {"lines": 131, "prob_bits": 11, "partitions": 2}]


@pytest.mark.parametrize(
    ("changes", "reader"),
    [
        *((changes, read_by_toolchain) for changes in CHANGES),
        pytest.param(CHANGES[0], read_by_srec_cat, marks=pytest.mark.process),
        *(pytest.param(changes, read_by_srec_cat, marks=pytest.mark.thorough) for changes in CHANGES[1:]),
    ],
)
def test_the_memories_hold_what_the_images_hold(tmp_path, changes, reader):
    """Every word of every memory, also of those that are thousands of bits wide."""
    if reader is read_by_srec_cat and shutil.which("srec_cat") is None:
        pytest.skip("srec_cat is not there; Debian has it in the package srecord")
    images = build(tmp_path, select=True, **changes)
    folder = tmp_path / "bm_arch" / "Memory_MIFs"
    left = {path.name for path in folder.iterdir()}
    for board, image in enumerate(images):
        machine, parameters = image.machine, image.machine.parameters
        wide = parameters.prob_bits * parameters.lines
        expected = {
            f"board{board}_{name}.mif": (wide, words_of(machine, table))
            for name, table in zip(
                ("prior", "column1", "column2"), (machine.prior, *machine.tables), strict=True
            )
        }
        if parameters.prior_mode is PriorMode.WRITTEN:  # a word a line: what PRIOR_CODES holds first
            expected[f"board{board}_prior.mif"] = (parameters.prob_bits, machine.prior[0].tolist())
        banks = [random_numbers(machine).restart(bank) for bank in range(parameters.rng_banks)]
        seeds = "rng_seeds.mif" if parameters.shared else f"board{board}_rng_seeds.mif"
        expected[seeds] = (parameters.rng.lfsr_bits or 16, np.ravel(banks).tolist())
        if machine.rng_table is not None:
            expected["rng_table.mif"] = (parameters.prob_bits, machine.rng_table.tolist())
        assert {name: reader(folder / name, tmp_path) for name in expected} == expected
        left -= expected.keys()
    assert not left


PROBE = """
use work.bm1_parameters.all;
use std.textio.all;
library ieee; use ieee.std_logic_1164.all;
entity probe is end entity;
architecture run of probe is
  procedure say(what : string) is variable text : line; begin
    write(text, what); writeline(output, text);
  end procedure;
begin
  process begin
    say("lines " & to_string(LINES) & " sensors " & to_string(SENSORS) & " columns " & to_string(COLUMNS));
    say("bits " & to_string(PROB_BITS) & " " & to_string(PRIOR_BITS) & " " & to_string(COUNTER_BITS));
    for c in SENSOR_BITS'range loop say("sensor " & to_string(c) & " " & to_string(SENSOR_BITS(c))); end loop;
    say("rng " & rng_kind_t'image(RNG_KIND) & " " & to_string(RNG_SHARED) & " " & to_string(STEPS_PER_CLOCK)
        & " " & to_string(RNG_RESET_BANK) & " " & to_string(RNG_BANKS) & " " & to_string(PRIOR_WRITTEN));
    say("stop " & to_hstring(TARGET_COUNT) & " " & to_hstring(MAX_CYCLES));
    say("interface " & to_string(INTERFACE_SENSORS) & " " & to_string(INTERFACE_RESULTS));
    say("hashes " & to_hstring(MAP_HASH) & " " & to_hstring(MODEL_HASH));
    for b in PARTITIONS'range loop
      say("board " & to_string(b) & " " & to_string(PARTITIONS(b).lines) & " "
          & to_string(PARTITIONS(b).line_offset) & " " & to_hstring(PARTITIONS(b).image_hash));
    end loop;
    {more}
    wait;
  end process;
end architecture;
"""
SEEDS = """for b in RNG_SEEDS'range(1) loop for c in RNG_SEEDS'range(2) loop
      say("seed " & to_string(b) & " " & to_string(c) & " " & to_string(RNG_SEEDS(b, c)));
    end loop; end loop;"""


def ghdl(folder, *arguments):
    done = subprocess.run(
        ["ghdl", *arguments],
        check=False,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.thorough
@pytest.mark.parametrize(
    "changes",
    [KINDS[1], KINDS[2], KINDS[4], {"rng": RngKind.IDEAL}],
    ids=["lfsr8", "cells", "table", "ideal"],
)
def test_ghdl_finds_every_parameter(tmp_path, changes):
    if shutil.which("ghdl") is None:
        pytest.skip("ghdl is not there; Debian has it in a package of this name")
    images = build(tmp_path, **changes)
    deployment, parameters = load_deployment(tmp_path), images[0].machine.parameters
    seeds = parameters.shared and parameters.rng is not RngKind.IDEAL
    (tmp_path / "probe.vhd").write_text(PROBE.format(more=SEEDS if seeds else ""))
    ghdl(tmp_path, "-a", "--std=08", "bm_arch/bm1_parameters.vhd", "probe.vhd")
    said = ghdl(tmp_path, "--elab-run", "--std=08", "probe").lower().splitlines()
    image = images[0]
    assert said == [
        f"lines {deployment.machine.lines} sensors 2 columns 3",
        f"bits {parameters.prob_bits} 0 {parameters.counter_bits}",
        "sensor 1 4",
        "sensor 2 2",
        f"rng rng_{parameters.rng} {parameters.shared} {parameters.steps_per_clock} "
        f"{parameters.rng_reset == 'bank'} {parameters.rng_banks} {parameters.prior_mode == 'written'}".lower(),
        f"stop {deployment.machine.target_count:08x} {131072:016x}",
        "interface 20 1200",
        f"hashes {image.map_hash} {image.model_hash}",
        *(
            f"board {b} {each.machine.parameters.lines} {each.partition.line_offset} {each.image_hash}"
            for b, each in enumerate(images)
        ),
        *(
            f"seed {bank} {column} {int(seed):0{16 if parameters.rng is RngKind.TABLE else 8}b}"
            for bank in range(parameters.rng_banks if seeds else 0)
            for column, seed in enumerate(random_numbers(image.machine).restart(bank))
        ),
    ]


@pytest.fixture
def bare(tmp_path):
    """A machine without sensors, whose seeds are in the memory alone."""
    place = interval("x", 0, 10, cells=2)
    one = Model(name="p", searched=(place,), known=())
    build_model(one, tmp_path, rng_banks=5000)
    return tmp_path / "bm_arch"


def test_no_sensors_and_many_seeds(bare):
    text = (bare / "bm1_parameters.vhd").read_text()
    assert "SENSOR_BITS       : natural_array_t(1 to 0) := (others => 0);" in text
    assert "RNG_SEEDS" not in text
    assert len(read_mif(bare / "Memory_MIFs" / "rng_seeds.mif").words) == 5000


@pytest.mark.thorough
def test_ghdl_takes_an_empty_array_of_widths(bare):
    if shutil.which("ghdl") is None:
        pytest.skip("ghdl is not there; Debian has it in a package of this name")
    ghdl(bare, "-a", "--std=08", "bm1_parameters.vhd")


def test_the_project_has_a_revision_for_every_board_and_names_harm_no_file(tmp_path):
    build(tmp_path, partitions=2)
    project = (tmp_path / "bm1.qpf").read_text()
    assert re.findall(r'PROJECT_REVISION = "(.*)"', project) == ["bm1_board0", "bm1_board1"]
    for board in range(2):
        text = (tmp_path / f"bm1_board{board}.qsf").read_text()
        named = re.findall(r'-name (?:MIF|VHDL)_FILE "(.*)"', text)
        assert all((tmp_path / name).is_file() for name in named)
        memories = {f"board{board}_{name}.mif" for name in ("prior", "column1", "column2")}
        assert {name.rpartition("/")[2] for name in named} == {
            "bm1_parameters.vhd",
            "rng_seeds.mif",
        } | memories
        assert f"set_parameter -name BOARD {board}\n" in text
        assert "DEVICE 5SGSMD8" in text
    assert "foreach revision {bm1_board0 bm1_board1} {" in (tmp_path / "bm1.tcl").read_text()
    for path in tmp_path.glob("bm1*"):
        assert "NOT VERIFIED BY QUARTUS" in path.read_text()
    for path in tmp_path.rglob("*.*"):
        if path.suffix in {".vhd", ".mif", ".qsf", ".qpf", ".tcl"}:
            text = path.read_text(encoding="ascii")
            named = [line for line in text.splitlines() if "quoted" in line or "D %1" in line]
            assert all(re.search(r"(^#|--).*(quoted|D %1)", line) for line in named)
    assert "tiles, P(D %1; | S)" in (tmp_path / "bm_arch" / "Memory_MIFs" / "board0_column1.mif").read_text()


TCL = """
package provide ::quartus::project 1
package provide ::quartus::flow 1
proc project_open args { puts "open $args" }
proc project_close {} { puts close }
proc set_global_assignment args { puts "set $args" }
proc export_assignments {} { puts export }
proc execute_flow args { puts "flow $args" }
set quartus(args) [list $folder]
source bm1.tcl
"""


@pytest.mark.thorough
def test_the_script_names_the_sources_and_compiles_every_board(tmp_path):
    if shutil.which("tclsh") is None:
        pytest.skip("tclsh is not there; Debian has it in the package tcl")
    build(tmp_path, partitions=2)
    (tmp_path / "hdl").mkdir()
    for name in ("b.vhd", "a.vhd", "c.txt"):
        (tmp_path / "hdl" / name).touch()
    expected = []
    for board in range(2):
        expected += [f"open bm1 -revision bm1_board{board}"]
        expected += [f"set -name VHDL_FILE hdl/{name}.vhd" for name in "ab"]
        expected += ["export", "flow -compile", "close"]
    for folder, lines in (("hdl", expected), ("boards", [])):
        script = f"set folder {folder}\n{TCL}"
        done = subprocess.run(
            ["tclsh"],
            check=False,
            input=script,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=PROCESS_PATIENCE,
        )
        assert done.stdout.splitlines() == lines
    assert "error: no .vhd file in 'boards'" in done.stderr


def test_generators_that_exist_emulated_only_have_no_seeds_and_no_project(tmp_path):
    build(tmp_path, partitions=2)
    build(tmp_path, rng=RngKind.IDEAL)
    assert not list(tmp_path.glob("bm1*"))
    assert sorted(path.name for path in (tmp_path / "bm_arch" / "Memory_MIFs").iterdir()) == [
        "board0_column1.mif",
        "board0_column2.mif",
        "board0_prior.mif",
    ]


ELSEWHERE = """
import sys
from dataclasses import replace
from pathlib import Path
from tests.toolchain.outputs.test_memories import model
from tests.toolchain.running import OPTIONS
from toolchain.building.build import build_deployment
from toolchain.building.machine import plan_machine
options = replace(OPTIONS, partitions=2, build_date="2020-02-02T02:02:02Z")
build_deployment(plan_machine(model(), options), Path(sys.argv[1]))
"""


@pytest.mark.thorough
def test_the_same_bytes_in_another_folder_locale_and_hash_seed(tmp_path):
    found = []
    for number, language in enumerate(["C", "C.UTF-8"]):
        folder = tmp_path / f"number {number}"
        place = {"PYTHONHASHSEED": str(number), "LC_ALL": language, "TZ": ["UTC", "Asia/Tokyo"][number]}
        subprocess.run(
            [sys.executable, "-c", ELSEWHERE, folder],
            check=True,
            timeout=PROCESS_PATIENCE,
            env=os.environ | place,
        )
        found.append(contents(folder))
    assert found[0] == found[1]
    for name, content in found[0].items():
        assert str(tmp_path).encode() not in content, name
        assert b"2020" not in content or name.endswith(".bm"), name
    memories = [f"board{i}_{what}" for i in range(2) for what in ("prior", "column1", "column2")]
    assert set(found[0]) == {
        *("deployment.toml", "report.txt", "bm1.qpf", "bm1.tcl", "bm_arch/bm1_parameters.vhd"),
        *(f"boards/board{i}.bm" for i in range(2)),
        *(f"bm1_board{i}.qsf" for i in range(2)),
        *(f"bm_arch/Memory_MIFs/{each}.mif" for each in ("rng_seeds", *memories)),
    }
