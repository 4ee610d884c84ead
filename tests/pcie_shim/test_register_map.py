"""The committed constants and documentation, compared with the SystemRDL file."""

import dataclasses
from pathlib import Path

import pytest

from machines.bm1 import StopReason
from machines.parameters import RngKind
from pcie_shim import register_map
from pcie_shim.framing import MAX_PAYLOAD_WORDS
from scripts.register_maps import generator


@pytest.fixture(scope="module")
def generated() -> generator.RegisterMap:
    return generator.read_map()


def test_every_generated_file_is_up_to_date(generated: generator.RegisterMap) -> None:
    files = generator.generated_files(generated)
    assert {path.name for path in files} == {
        "register_map.py",
        "registers.md",
        "bm_register_map.vhd",
        "bm_register_block.vhd",
        "bm_registers.h",
    }
    for path, text in files.items():
        assert path.read_text() == text, f"{path.name} is out of date: run scripts/registers"


def test_check_says_what_is_out_of_date(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "docs/reference").mkdir(parents=True)
    monkeypatch.setattr(generator, "ROOT", tmp_path)
    for name in ("PACKAGE", "REGISTER_BLOCK", "HEADER"):
        monkeypatch.setattr(generator, name, tmp_path / name)
    monkeypatch.setattr(generator, "MODULE", tmp_path / "register_map.py")
    monkeypatch.setattr(generator, "DOCUMENT", tmp_path / "docs/reference/registers.md")
    with pytest.raises(SystemExit, match="1"):
        generator.main(["--check"])
    assert "register_map.py is out of date: run scripts/registers" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        generator.main([])
    with pytest.raises(SystemExit, match="0"):
        generator.main(["--check"])


def test_the_hash_covers_the_definition_and_not_the_words(generated: generator.RegisterMap) -> None:
    first, *rest = generated.blocks
    reworded = dataclasses.replace(first, text="other words", title="another title")
    moved = dataclasses.replace(first, address=first.address + 4)
    field = dataclasses.replace(first.fields[0], reset=1)
    assert dataclasses.replace(generated, blocks=(reworded, *rest)).hash == generated.hash
    assert dataclasses.replace(generated, blocks=(moved, *rest)).hash != generated.hash
    changed = dataclasses.replace(first, fields=(field,))
    assert dataclasses.replace(generated, blocks=(changed, *rest)).hash != generated.hash


def test_stop_reasons_and_rngs_are_the_machines() -> None:
    assert {(each.name, each.value) for each in register_map.StopReason} == {
        (each.name, each.value) for each in StopReason
    }
    assert {each.name for each in register_map.RngKind} - {"NONE"} == {each.name for each in RngKind}


def test_blocks_neither_overlap_nor_outgrow_a_frame() -> None:
    end = 0
    for block in register_map.BLOCKS:
        assert block.address >= end
        assert block.words <= MAX_PAYLOAD_WORDS
        end = block.address + 4 * block.words
    assert end <= register_map.BAR_SIZE
