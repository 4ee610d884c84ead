"""The committed constants and documentation, compared with the SystemRDL file."""

from machines import KINDS
from machines.bm1 import StopReason
from machines.bm1_kind import BM1
from machines.bm2 import BM2Parameters
from machines.bm2_kind import BM2
from machines.parameters import BM1Parameters, RngKind, SensorMode
from pcie_shim import register_map
from pcie_shim.framing import MAX_PAYLOAD_WORDS
from scripts.register_map import SOURCE, RegisterMap, main


def test_every_generated_file_is_up_to_date():
    assert main(["--check"]) == 0, "run scripts/registers"


def test_the_hash_covers_the_definition_and_not_the_words(tmp_path):
    text = SOURCE.read_text()

    def hash_with(old, new):
        assert old in text
        (tmp_path / "other.rdl").write_text(text.replace(old, new, 1))
        return RegisterMap(tmp_path / "other.rdl").hash

    assert hash_with('name = "Identity"', 'name = "Other"') == register_map.MAP_SHA256
    assert hash_with("0x31304D42", "0x31304D43") != register_map.MAP_SHA256
    assert hash_with("OVERFLOW = 1", "OVERFLOW = 9") != register_map.MAP_SHA256


def test_the_encodings_are_the_machines_numbers():
    encodings = {
        encoding.type_name: {each.name: int(each.value) for each in encoding}
        for encoding in RegisterMap(SOURCE).encodings
    }
    assert encodings["stop_reason"].items() >= {each.name: each.value for each in StopReason}.items()
    assert set(encodings["stop_reason"].values()) == set(BM1.reasons) | set(BM2.reasons)

    def number(field, **parameters):
        used = BM1.registers(BM1Parameters(lines=1, sensor_bits=(8,), **parameters))
        return used.capabilities[f"CAP_MACHINE.{field}"]

    of_bm2 = BM2.registers(BM2Parameters(cardinalities=(2,), factors=((0,),))).capabilities
    kinds = {"BM1": number("KIND"), "BM2": of_bm2["CAP_MACHINE.KIND"]}
    assert list(kinds) == list(KINDS)
    assert encodings["machine_kind"] == {"NONE": 0} | kinds
    rngs = {each.name: number("RNG", rng=each, prob_bits=7) for each in RngKind}
    assert encodings["rng_kind"] == {"NONE": 0} | rngs
    modes = {each.name: number("SENSOR_MODE", sensor_mode=each) for each in SensorMode}
    assert encodings["sensor_mode"] == modes


def test_blocks_neither_overlap_nor_outgrow_a_frame():
    end = 0
    for block in register_map.BLOCKS.values():
        assert block >= end
        assert block.words <= MAX_PAYLOAD_WORDS
        end = block + 4 * block.words
    assert end <= register_map.BAR_SIZE
