"""Images from edited memories and parameters: what is taken, what is said, and what is refused."""

import contextlib
import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from machines.parameters import RngReset
from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import EmulatedBoard, RefusedError
from pcie_shim.programming_file import image_bytes, read_image
from pcie_shim.register_layout import next_doorbell
from pcie_shim.register_map import ErrorCode
from services.boards.hardware import Engine, SimulatedHardware
from tests.toolchain.building import test_regenerate
from tests.toolchain.running import TARGET, assert_refused, contents, done, toolchain
from toolchain.building.edited_sources import regenerate_images
from toolchain.checks.check import check_deployment
from toolchain.deployment import load_deployment
from toolchain.outputs import output_files

MODEL = test_regenerate.MODEL
COLUMN = "bm_arch/Memory_MIFs/board1_column2.mif"
PARAMETERS = "bm_arch/bm1_parameters.vhd"


@pytest.fixture
def built(case):
    out = case.parent / "out"
    done(toolchain("build", case, "-o", out, *TARGET, "--partitions", "2", "--prob-bits", "7"))
    return out


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def with_word(path, address, change):
    """Replace the word at an address of a canonical file."""
    lines = path.read_text().splitlines(keepends=True)
    at = next(n for n, line in enumerate(lines) if line.startswith(f"{address:X} : "))
    word = lines[at].split(" : ")[1].strip().rstrip(";")
    lines[at] = f"{address:X} : {change(int(word, 16)):0{len(word)}X};\n"
    path.write_text("".join(lines))


def images(folder):
    return [read_image(folder / "boards" / f"board{at}.bm") for at in (0, 1)]


@pytest.mark.parametrize(
    "options",
    [[], ["--sensor-mode", "threshold"], ["--prior-mode", "written", "--rng", "table"], ["--per-cell"]],
)
def test_sources_as_they_were_built_change_nothing(case, options):
    out = case.parent / "plain"
    done(toolchain("build", case, "-o", out, *TARGET, *options))
    before = contents(out)
    assert "edited" not in done(toolchain("regenerate", "images", out)).stdout
    assert contents(out) == before


def test_an_edited_code_is_that_of_the_image_and_of_nothing_else(built):
    before, originals = images(built), contents(built)
    with_word(built / COLUMN, 3, lambda word: word & ~(0x7F << 7) | 0x55 << 7)
    printed = done(toolchain("regenerate", "images", built)).stdout
    old = int(before[1].machine.tables[1][3, 1])
    assert f"edited     {COLUMN}: 1 code: address 0x3 of the model's line 5: {old:#x} -> 0x55\n" in printed
    after = images(built)
    assert after[1].machine.tables[1][3, 1] == 0x55
    codes = [(old.machine, new.machine) for old, new in zip(before, after, strict=True)]
    changed = [
        (board, column, *np.argwhere(one != two).tolist())
        for board, (old_machine, new_machine) in enumerate(codes)
        for column, (one, two) in enumerate(zip(old_machine.tables, new_machine.tables, strict=True))
        if (one != two).any()
    ]
    assert changed == [(1, 1, [3, 1])]
    deployment = load_deployment(built)  # whose hashes are those of the new images
    assert deployment.edited_boards == (1,)
    found = toolchain("check", built, "--json").stdout.splitlines()
    assert [each["about"] for each in map(json.loads, found) if each["check"] == "edited"] == ["board 1"]
    assert not [each for each in map(json.loads, found) if each["check"] == "files"]
    for model in ([], ["--model", built.parent / "case"]):
        report = done(toolchain("inspect", built, *model, "--frames", 3)).stdout
        assert report.count("Edited since the build: the image of board 1.") == 1
    other = toolchain("inspect", built, "--model", built.parent / "none")
    assert other.exit_code == 2
    # the way back: by hand, or from the model
    with_word(built / COLUMN, 3, lambda word: word & ~(0x7F << 7) | old << 7)
    edited = contents(built)
    done(toolchain("regenerate", "images", built))
    assert contents(built) == originals != edited


def test_the_model_replaces_an_edit(case, built):
    originals = contents(built)
    with_word(built / COLUMN, 3, lambda word: word ^ 1)
    done(toolchain("regenerate", "images", built))
    assert not done(toolchain("regenerate", "memories", built, "--model", case)).stderr
    assert contents(built) == originals


def test_every_form_of_a_memory_is_read(built):
    """Another radix, runs, ranges and comments give the same codes, and the canonical file."""
    before = contents(built)
    (built / "bm_arch/Memory_MIFs/board0_prior.mif").write_text(
        "% by hand % depth = 1; width = 28; data_radix = bin; address_radix = uns; content begin\n"
        f"0 : {'1111111' * 4}; -- all\nend;"
    )
    done(toolchain("regenerate", "images", built))
    assert contents(built) == before


def test_edited_parameters_are_those_of_the_machine(case, built):
    path, originals = built / PARAMETERS, contents(built)
    edit(path, "STEPS_PER_CLOCK   : positive := 8", "STEPS_PER_CLOCK : positive := 1 -- slower\n ")
    edit(path, "RNG_RESET_BANK    : boolean := true", "RNG_RESET_BANK : Boolean := FALSE")
    edit(path, 'x"0000007F"' if 'x"0000007F"' in path.read_text() else 'x"000000FF"', 'x"00000040"')
    printed = done(toolchain("regenerate", "images", built)).stdout
    assert "STEPS_PER_CLOCK 8 -> 1" in printed
    assert "RNG_RESET_BANK true -> false" in printed
    deployment = load_deployment(built)
    machine = deployment.machine
    assert (machine.steps_per_clock, machine.rng_reset, machine.target_count) == (1, RngReset.FREE, 0x40)
    assert all(image.machine.parameters.steps_per_clock == 1 for image in images(built))
    assert deployment.edited_boards == (0, 1)
    again = contents(built)
    done(toolchain("regenerate", "deployment", built))  # file and images agree
    done(toolchain("regenerate", "images", built))
    assert contents(built) == again
    # the model has no parameters, and the deployment only the edited ones
    assert PARAMETERS in done(toolchain("regenerate", "memories", built, "--model", case)).stderr
    assert load_deployment(built).machine == machine
    assert load_deployment(built).edited_boards == (0, 1)
    path.write_bytes(originals[PARAMETERS])  # undone: the deployment that was built
    done(toolchain("regenerate", "images", built))
    # whose report is that of the edited parameters
    assert contents(built) | {"report.txt": originals["report.txt"]} == originals


def test_another_model_is_no_edit(case, built):
    """Its codes replace an edit of the codes, as a build would."""
    with_word(built / COLUMN, 3, lambda word: word ^ 1)
    done(toolchain("regenerate", "images", built))
    edit(case / "model.py", "sigma=sigma", "sigma=2 * sigma")
    done(toolchain("regenerate", "memories", built, "--model", case))
    assert load_deployment(built).edited_boards == ()


def interrupted(monkeypatch, folder, last):
    """Make images, and stop after the file of this name is written, as a killed process does."""
    whole = output_files._write

    def write(path, pieces):
        whole(path, pieces)
        if path.name == last:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(output_files, "_write", write)
        with pytest.raises(KeyboardInterrupt):
            regenerate_images(folder)


@pytest.mark.parametrize("last", ["board0.bm", "board1.bm", "bm1_parameters.vhd", "board0_prior.mif"])
def test_an_interrupted_command_goes_on(case, built, monkeypatch, last):
    """With the same edits, and with others; the model's way back is open, too."""
    other, originals = case.parent / "other", contents(built)
    for column in ("board0_column1.mif", Path(COLUMN).name):
        with_word(built / "bm_arch/Memory_MIFs" / column, 3, lambda word: word ^ 1)
    interrupted(monkeypatch, built, last)
    assert_refused(toolchain("inspect", built, "--frames", 1), "'toolchain regenerate' was interrupted")
    shutil.copytree(built, other)
    done(toolchain("regenerate", "memories", other, "--model", case))
    assert contents(other) == originals
    edit(built / PARAMETERS, "STEPS_PER_CLOCK   : positive := 8", "STEPS_PER_CLOCK : positive := 1")
    interrupted(monkeypatch, built, last)
    shutil.rmtree(other)
    shutil.copytree(built, other)
    done(toolchain("regenerate", "images", built))
    assert load_deployment(built).edited_boards == (0, 1)
    for image in images(built):
        assert image.machine.parameters.steps_per_clock == 1
    # undone: the deployment that was built
    for name in originals:
        if name.endswith((".mif", ".vhd")):
            (other / name).write_bytes(originals[name])
    done(toolchain("regenerate", "images", other))
    assert contents(other) == originals


def test_an_interrupted_change_of_a_bm2_goes_on(network, tmp_path, monkeypatch):
    out = tmp_path / "out"
    asked = ("--searched", "rain", "--known", "shoes", "--machine", "bm2", "--partitions", "2")
    done(toolchain("build", network, "-o", out, *TARGET, *asked))
    with_word(out / "bm_arch/Memory_MIFs/cde0.mif", 0, lambda word: word ^ 3)
    interrupted(monkeypatch, out, "board0.bm")
    done(toolchain("regenerate", "images", out))
    assert [board.built_hash is None for board in load_deployment(out).boards] == [False, False]
    one, two = images(out)
    assert one.machine.tables[0][0] == two.machine.tables[0][0]


def test_images_of_another_build_are_no_basis(case, network, built):
    """Neither other sizes, nor another model of the same sizes, nor another board's."""
    other = case.parent / "other"
    done(
        toolchain(
            "build", case, "-o", other, *TARGET, "--partitions", "2", "--prob-bits", "7", "--set", "sigma=2"
        )
    )
    original = (built / "boards/board1.bm").read_bytes()
    for source in (other / "boards/board1.bm", built / "boards/board0.bm"):
        shutil.copy(source, built / "boards/board1.bm")
        before = contents(built)
        assert_refused(toolchain("regenerate", "images", built), "board1.bm")
        assert contents(built) == before
    (built / "boards/board1.bm").write_bytes(original)
    shutil.copy(other / "boards/board0.bm", built / "boards/board0.bm")
    assert_refused(toolchain("regenerate", "images", built), "MODEL_HASH")
    shutil.rmtree(other)
    asked = ("--searched", "rain", "--known", "shoes", "--machine", "bm2")
    done(toolchain("build", network, "-o", other, *TARGET, *asked))
    shutil.copy(other / "boards/board0.bm", built / "boards/board0.bm")
    assert_refused(toolchain("regenerate", "images", built), "type = BM1", "board0.bm", "BM2")


def test_the_check_of_an_edit_names_both_ways(built):
    with_word(built / COLUMN, 3, lambda word: word ^ 1)
    edit(built / PARAMETERS, "STEPS_PER_CLOCK   : positive := 8", "STEPS_PER_CLOCK : positive := 1")
    (found,) = [each for each in check_deployment(built) if each.check == "files"]
    assert "and 1 more file;" in found.sentence
    assert all(f"'toolchain regenerate {each} {built}'" in found.advice for each in ("images", "memories"))
    done(toolchain("regenerate", "images", built))
    assert "with 1 step per clock" in done(toolchain("inspect", built, "--frames", 2)).stdout


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        (COLUMN, "\n3 : ", "\n3 : FF", ["line 11", "28 bits"]),
        (COLUMN, "DEPTH=16;", "DEPTH=32;", ["line 4", "DEPTH is 32", "16"]),
        (COLUMN, "\n3 : ", "\n2 : ", ["line 11", "address 2 is given twice"]),
        (COLUMN, "\n3 : ", "\n-- 3 : ", ["address 3 is missing"]),
        (COLUMN, "\nF : F", "\nF : E", ["board1_column2.mif", "missing reading"]),
        ("bm_arch/Memory_MIFs/rng_seeds.mif", "\n00 : ", "\n00 : 1", ["rng_seeds.mif", "line"]),
        (
            PARAMETERS,
            "positive := 8;  -- of the whole model",
            "positive := 9;",
            ["line 23", "LINES", "found 9"],
        ),
        (PARAMETERS, "STEPS_PER_CLOCK   : positive := 8", "STEPS_PER_CLOCK : positive := eight", ["eight"]),
        (PARAMETERS, "STEPS_PER_CLOCK   : positive := 8", "STEPS_PER_CLOCK : positive := 99999", ["99999"]),
        (
            PARAMETERS,
            'x"000000FF"',
            'x"00000000"',
            ["line ", 'TARGET_COUNT is x"00000000", expected greater'],
        ),
        (PARAMETERS, "RNG_LFSR32;", "RNG_LFSR16;", ["RNG_KIND", "rng_lfsr16", "'toolchain build --rng'"]),
        (PARAMETERS, "RNG_BANKS         : positive := 16", "RNG_BANKS : positive := 8", ["--rng-banks'"]),
        (PARAMETERS, "RNG_SHARED        : boolean := true", "RNG_SHARED : boolean := false", ["--per-cell'"]),
        (PARAMETERS, "constant COUNTER_BITS", "constant COUNTER", ["COUNTER_BITS"]),
        (PARAMETERS, "end package", "or package", ["line", "end", "or"]),
        (PARAMETERS, "COUNTER_BITS      : positive := 8", "COUNTER_BITS : positive := 4", ["target"]),
    ],
)
def test_what_is_not_this_machine_is_refused_and_changes_nothing(built, name, old, new, words):
    edit(built / name, old, new)
    before = contents(built)
    assert_refused(toolchain("regenerate", "images", built), *words)
    assert contents(built) == before


def test_a_missing_or_empty_source_is_named(built):
    (built / PARAMETERS).write_text("")
    assert_refused(toolchain("regenerate", "images", built), PARAMETERS, "COUNTER_BITS")
    (built / COLUMN).unlink()
    done(toolchain("regenerate", "memories", built))
    (built / COLUMN).unlink()
    assert_refused(toolchain("regenerate", "images", built), COLUMN)


def test_a_cde_of_a_bm2_is_edited_on_all_boards(network, tmp_path):
    out = tmp_path / "out"
    asked = ("--searched", "rain", "--known", "shoes", "--machine", "bm2", "--partitions", "2")
    done(toolchain("build", network, "-o", out, *TARGET, *asked))
    before = contents(out)
    done(toolchain("regenerate", "images", out))
    assert contents(out) == before
    with_word(out / "bm_arch/Memory_MIFs/cde0.mif", 0, lambda word: word ^ 3)
    done(toolchain("regenerate", "images", out))
    found = [image.machine.tables[0][0] for image in images(out)]
    assert found[0] == found[1]
    assert load_deployment(out).edited_boards == (0, 1)
    for model in ([], ["--model", network, "--searched", "rain", "--known", "shoes"]):
        report = done(toolchain("inspect", out, *model, "--frames", 2)).stdout
        assert report.count("Edited since the build") == 1


def counts(board, image, addresses):
    """The counts and cycles of a frame, on a board that is driven by hand."""
    board.write(rm.SENSORS, struct.pack(f"<{len(addresses)}I", *addresses))
    board.write(rm.TARGET_COUNT, struct.pack("<5I", 60, 4000, 0, 0, 0))
    board.write(rm.RUN_UNTIL, struct.pack("<4I", 0, 0, next_doorbell(board.done), 0))
    while board.running:
        board.step()
    return board.read(rm.RESULTS, image.machine.parameters.lines), board.read(rm.CYCLES, 2)


@pytest.mark.thorough
@pytest.mark.skipif(
    shutil.which("ghdl") is None, reason="ghdl is not installed (Debian: apt-get install ghdl)"
)
def test_vhdl_with_the_edited_memories_counts_as_the_emulated_board(built, tmp_path):
    before = images(built)[1]
    for address in (3, 4):
        with_word(built / COLUMN, address, lambda word: word ^ 0xFFFFFFF)
    done(toolchain("regenerate", "images", built))
    image = images(built)[1]
    simulated = SimulatedHardware(Engine.GHDL, tmp_path / "hardware", {0: image}).board(0)
    emulated, unedited = EmulatedBoard(), EmulatedBoard()
    emulated.load(image_bytes(image))
    unedited.load(image_bytes(before))
    (used,) = (tmp_path / "hardware").rglob(f"*/{Path(COLUMN).name}")
    content = [
        [line for line in path.read_text().splitlines() if line[:2] != "--"]
        for path in (used, built / COLUMN)
    ]
    assert content[0] == content[1]  # the hardware's memory is the edited file
    with contextlib.closing(simulated):
        simulated.prepare(image)
        while True:
            try:
                simulated.load(image_bytes(image))
                break
            except RefusedError as error:
                assert error.code == ErrorCode.BUSY
        for addresses in ((2, 3), (5, 4), (7, 9)):
            found = counts(simulated, image, addresses)
            assert found == counts(emulated, image, addresses)
            assert (found == counts(unedited, image, addresses)) is (addresses[1] == 9)
