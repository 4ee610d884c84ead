"""MIFs in every form, every memory of a machine as one, the parameters as a VHDL package, and Quartus's project."""

import os
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.parameters import PriorMode, RngKind, RngReset
from machines.rng import POLYNOMIALS, random_numbers
from pcie_shim.programming_file import read_image
from tests.patience import PROCESS_PATIENCE
from tests.toolchain.builders import interval, normal
from tests.toolchain.running import TARGET, TINY, build_model, contents
from toolchain.deployment import load_deployment
from toolchain.errors import MifError
from toolchain.models.model import Known, Model, PriorSelect, cell_centres
from toolchain.outputs.mif import Mif, mif_lines, parse_mif, random_table, read_mif

HEAD = "WIDTH=8; DEPTH=8; ADDRESS_RADIX=HEX; DATA_RADIX=HEX;\nCONTENT BEGIN\n"


def mif_text(mif, comments=()):
    return "".join(mif_lines(mif.width, len(mif.words), mif.words, comments))


@st.composite
def memories(draw):
    width = draw(st.sampled_from([1, 3, 8, 12, 32, 57, 64, 130, 4096]))
    return Mif(width, tuple(draw(st.lists(st.integers(0, 2**width - 1), min_size=1, max_size=300))))


@given(memories(), st.lists(st.text(), max_size=3))
def test_what_is_written_is_read(memory, comments):
    text = mif_text(memory, comments)
    assert text.isascii()
    assert parse_mif(text) == memory


def test_the_canonical_form():
    assert mif_text(Mif(10, (0, 1023, 5)), ["a\nb é"]) == (
        "-- a\\nb \\xe9\nWIDTH=10;\nDEPTH=3;\nADDRESS_RADIX=HEX;\nDATA_RADIX=HEX;\nCONTENT BEGIN\n"
        "0 : 000;\n1 : 3FF;\n2 : 005;\nEND;\n"
    )


@given(
    st.data(),
    st.sampled_from(["BIN", "OCT", "DEC", "HEX", "UNS"]),
    st.sampled_from(["BIN", "OCT", "DEC", "HEX", "UNS"]),
)
def test_every_form_is_read(data, address_radix, data_radix):
    """A memory cut into runs, ranges and single words, in any radix, with comments between."""
    words = data.draw(st.lists(st.integers(0, 255), min_size=1, max_size=40))
    shape = {"BIN": "b", "OCT": "o", "DEC": "d", "HEX": "x", "UNS": "d"}

    def spoken(number):
        if data_radix == "DEC" and number >= 128 and data.draw(st.booleans()):
            return str(number - 256)
        return data.draw(st.sampled_from(["", "00"])) + format(number, shape[data_radix])

    def gap():
        return data.draw(st.sampled_from([" ", "\n", "\t", " -- 1 : 2;\n", " %8 : %", "%\n%\r\n"]))

    text = f"depth{gap()}={gap()}{len(words)};Width = 8 ; DATA_RADIX={data_radix};ADDRESS_RADIX = {address_radix.lower()};"
    text += f"{gap()}content{gap()}Begin{gap()}"
    at = 0
    while at < len(words):
        run = words[at : at + data.draw(st.integers(1, 6))]
        first, last = (format(end, shape[address_radix]) for end in (at, at + len(run) - 1))
        if data.draw(st.booleans()):
            said = run[:1] if len(set(run)) == 1 else run
            text += f"[{gap()}{first}{gap()}..{gap()}{last}{gap()}]{gap()}:"
        else:
            said = run
            text += f"{first}{gap()}:"
        text += gap() + gap().join(spoken(word) for word in said) + f"{gap()};{gap()}"
        at += len(run)
    assert parse_mif(text + data.draw(st.sampled_from(["END;", "end ;\n", "END"]))) == Mif(8, tuple(words))


def test_what_is_left_out_is_zero_hexadecimal_is_the_default_and_words_of_a_range_are_repeated():
    assert parse_mif("DEPTH=12;WIDTH=8;CONTENT BEGIN A:10; END;").words == (0,) * 10 + (16, 0)
    assert parse_mif(HEAD + "[1..5] : 1 2;\nEND;").words == (0, 1, 2, 1, 2, 1, 0, 0)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", 1),
        ("\n\nWITH=3;", 3),
        ("WIDTH=8;\nCONTENT BEGIN", 2),
        ("WIDTH=8;\nWIDTH=8;", 2),
        ("WIDTH=0;", 1),
        ("WIDTH=99999999999; DEPTH=1; CONTENT BEGIN END;", 1),
        ("DEPTH=" + "9" * 5000, 1),
        ("DATA_RADIX=ROMAN;", 1),
        ("WIDTH=8; DEPTH=8;\nCONTENT\nBEGUN", 3),
        (HEAD + "0 : 1;\n", 4),
        (HEAD + "0 : 100;", 3),
        (HEAD + "0 : 1_0;", 3),
        (HEAD + "0 : G;", 3),
        (HEAD + "8 : 1;", 3),
        (HEAD + "6 : 1 2\n3;", 4),
        (HEAD + "0 : " + "1 " * 9, 3),
        (HEAD + "0 : 1;\n[0..2] : 1;", 4),
        (HEAD + "[3..2] : 1;", 3),
        (HEAD + "[3,2] : 1;", 3),
        (HEAD + "% never\n ends", 3),
        (HEAD + "END;\n0 : 1;", 4),
        ("WIDTH=8; DEPTH=1; DATA_RADIX=DEC; CONTENT BEGIN 0 : -129; END;", 1),
    ],
)
def test_mistakes(text, line):
    with pytest.raises(MifError) as caught:
        parse_mif(text, "a.mif")
    assert str(caught.value).startswith("a.mif, line ")
    assert caught.value.line == line


@given(st.text(alphabet="WIDTHEPCON=8;:[]. 01A%-\n"))
def test_noise_is_refused_or_read_but_never_fails_otherwise(noise):
    with suppress(MifError):
        parse_mif(HEAD + noise)


def test_a_file(tmp_path):
    (tmp_path / "a.mif").write_bytes(b"-- \xe9\xff\n" + mif_text(Mif(4, (1, 2))).encode())
    assert read_mif(tmp_path / "a.mif") == Mif(4, (1, 2))
    with pytest.raises(MifError, match="No such file"):
        read_mif(tmp_path / "b.mif")


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


def words_of(machine, codes):
    """The words that the table in an image must have become: line 0 in the lowest bits."""
    bits = machine.parameters.prob_bits
    return [sum(code << bits * line for line, code in enumerate(row)) for row in codes.tolist()]


@pytest.mark.parametrize("changes", [*KINDS, {"lines": 131, "prob_bits": 11, "partitions": 2}])
def test_the_memories_hold_what_the_images_hold(tmp_path, changes):
    """Every word of every memory, also of those that are thousands of bits wide."""
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
        found = {name: read_mif(folder / name) for name in expected}
        assert {name: (mif.width, list(mif.words)) for name, mif in found.items()} == expected
        left -= expected.keys()
    assert not left


def constants(folder):
    """The constants of the package, as NAME=VALUE without comments and spaces, in lower case."""
    text = re.sub(r"\s*--.*", "", (folder / "bm_arch/bm1_parameters.vhd").read_text()).lower()
    found = re.findall(r"constant (\w+) +:[^:]*:=([^;]*);", text)
    return [f"{name}={''.join(value.split())}" for name, value in found]


@pytest.mark.parametrize(
    "changes",
    [KINDS[1], KINDS[2], KINDS[3], KINDS[4], {"rng": RngKind.IDEAL}],
    ids=["lfsr8", "cells", "free", "table", "ideal"],
)
def test_the_package_has_every_parameter(tmp_path, changes):
    images = build(tmp_path, **changes)
    image, parameters, table = images[0], images[0].machine.parameters, images[0].machine.rng_table
    width = parameters.rng.lfsr_bits or (64 if table is None else 16)
    digits = width // 4
    taps = sum(1 << (exponent - 1) for exponent in POLYNOMIALS.get(parameters.rng, ()))
    seeds = ""
    if parameters.rng is not RngKind.IDEAL:
        seeds = f"seed_bits={width}"
        if parameters.shared:
            banks = [random_numbers(image.machine).restart(bank) for bank in range(parameters.rng_banks)]
            rows = [",".join(f'{c}=>x"{int(s):0{digits}x}"' for c, s in enumerate(bank)) for bank in banks]
            seeds += f" rng_seeds=({','.join(f'{at}=>({row})' for at, row in enumerate(rows))})"
    partitions = ",".join(
        f"{at}=>(lines=>{each.machine.parameters.lines},line_offset=>{each.partition.line_offset},"
        f'image_hash=>x"{each.image_hash}")'
        for at, each in enumerate(images)
    )
    expected = (
        "lines=7 sensors=2 columns=3 replicas=1 sensor_mode=sensor_column sensor_bits=(1=>4,2=>2) "
        f"prob_bits={parameters.prob_bits} prior_bits=0 counter_bits={parameters.counter_bits} "
        f"prior_written={parameters.prior_mode is PriorMode.WRITTEN} "
        f'rng_kind=rng_{parameters.rng} rng_bits={width} rng_taps=x"{taps:0{digits}x}" '
        f"rng_table_length={1 if table is None else table.size} rng_shared={parameters.shared} "
        f"steps_per_clock={parameters.steps_per_clock} "
        f"rng_reset_bank={parameters.rng_reset is RngReset.BANK} rng_banks={parameters.rng_banks} {seeds} "
        f'target_count=x"{parameters.target_count_max:08x}" max_cycles=x"{131072:016x}" '
        f"interface_sensors={image.registers.input_words} interface_results={image.registers.result_words} "
        f'map_hash=x"{image.map_hash}" '
        f'boards={len(images)} model_hash=x"{image.model_hash}" partitions=({partitions})'
    )
    assert constants(tmp_path) == expected.lower().split()


@pytest.mark.process
def test_no_sensors_and_many_seeds(tmp_path):
    """A machine whose package has an empty array, and whose seeds are in the memory alone."""
    build_model(
        Model(name="p", searched=(interval("x", 0, 10, cells=2),), known=()), tmp_path, rng_banks=5000
    )
    assert "rng_seeds=" not in " ".join(constants(tmp_path))
    assert len(read_mif(tmp_path / "bm_arch" / "Memory_MIFs" / "rng_seeds.mif").words) == 5000
    if shutil.which("ghdl") is None:
        pytest.skip("ghdl is not there; Debian has it in a package of this name")
    command = ["ghdl", "-a", "--std=08", "bm1_parameters.vhd"]
    subprocess.run(command, check=True, cwd=tmp_path / "bm_arch", timeout=PROCESS_PATIENCE)


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
        pipes = {"input": script, "capture_output": True, "text": True}
        done = subprocess.run(["tclsh"], check=False, cwd=tmp_path, timeout=PROCESS_PATIENCE, **pipes)
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


@pytest.mark.thorough
def test_the_same_bytes_in_another_folder_locale_and_hash_seed(tmp_path, case):
    (case / "model.py").write_text(TINY.replace('"tiny"', '"tïny"'), "utf-8")
    os.utime(case / "model.py", (1_580_608_922, 1_580_608_922))
    found = []
    for number, language in enumerate(["C", "C.UTF-8"]):
        folder = tmp_path / f"number {number}"
        place = {"PYTHONHASHSEED": str(number), "LC_ALL": language, "TZ": ["UTC", "Asia/Tokyo"][number]}
        command = [Path(sys.executable).with_name("toolchain"), "build", case, "-o", folder, *TARGET]
        subprocess.run(command, check=True, timeout=PROCESS_PATIENCE, env=os.environ | place)
        found.append(contents(folder))
    assert found[0] == found[1]
    for name, content in found[0].items():
        assert str(tmp_path).encode() not in content, name
        assert b"2020" not in content or name.endswith(".bm"), name
