"""Programming files: they are reproducible, survive a round trip, and a damaged or crafted one is refused."""

import dataclasses
import hashlib
import json
import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.bm1_kind import BM1
from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from pcie_shim import programming_file, register_map
from pcie_shim.errors import DamagedImageError, ImageError, ImageMismatchError
from pcie_shim.programming_file import Image, image_bytes, image_from_bytes, read_image
from pcie_shim.register_layout import interface_room
from tests.pcie_shim.boards import image, machine

MACHINES = [
    machine(1),
    machine(2, lines=3, sensor_bits=(), prior_bits=2, rng=RngKind.IDEAL, ideal_seed=2**64 - 1),
    machine(3, prob_bits=6, rng=RngKind.TABLE, rng_reset=RngReset.FREE, shared=False),
    machine(4, prior_mode=PriorMode.WRITTEN, counter_bits=20, rng=RngKind.LFSR16, rng_banks=2),
]


def manifest_of(content):
    length = int.from_bytes(content[8:12], "little")
    found: dict[str, object] = json.loads(content[48 : 48 + length])
    return found


@pytest.mark.parametrize("of", MACHINES)
def test_an_image_comes_back(of, tmp_path):
    path = tmp_path / "board0.bm"
    written = image(of, index=1, count=3, offset=7, total=100)
    path.write_bytes(image_bytes(written))
    found = read_image(path)
    for field in dataclasses.fields(Image):
        assert getattr(found, field.name) == getattr(written, field.name)
    assert found.image_hash == written.image_hash == manifest_of(path.read_bytes())["image_hash"]
    assert manifest_of(path.read_bytes())["emulated"] is True
    assert list(tmp_path.iterdir()) == [path]


def test_the_image_hash_is_of_what_the_board_computes():
    base = image(machine(1))
    later = dataclasses.replace(base, build_date="2027-01-01T00:00:00Z", tool_version="9")
    assert later.image_hash == base.image_hash
    assert image_bytes(later) != image_bytes(base)
    others = [
        image(machine(2)),
        image(machine(1, rng_banks=4)),
        image(machine(1), total=9),
        dataclasses.replace(base, interface_results=8),
        dataclasses.replace(base, model_hash="cd"),
    ]
    assert len({each.image_hash for each in (base, *others)}) == 6


@given(st.data())
def test_any_damage_is_found_and_named(data):
    content = bytearray(image_bytes(image(MACHINES[0])))
    position = data.draw(st.integers(0, len(content) - 1))
    content[position] ^= data.draw(st.integers(1, 255))
    length = int.from_bytes(content[8:12], "little")
    if 12 <= position < 16:
        return  # padding of the header
    with pytest.raises(ImageError) as caught:
        image_from_bytes(bytes(content), "boards/board0.bm")
    assert caught.value.exit_code == 2
    if position >= 16:
        # the sentence names the damaged part
        assert ("sha256 of section '" in str(caught.value)) is (position >= 48 + length)


@given(st.integers(0, 3000))
def test_a_shorter_or_longer_file_is_damaged(length):
    content = image_bytes(image(MACHINES[0]))
    for damaged in (content[: length % len(content)], content + bytes(1 + length)):
        with pytest.raises(DamagedImageError):
            image_from_bytes(damaged)


def test_a_file_that_agrees_with_itself_but_not_with_its_image_hash_is_damaged(monkeypatch):
    good = programming_file._manifest
    monkeypatch.setattr(
        programming_file,
        "_manifest",
        lambda *given: good(*given).model_copy(update={"image_hash": "00" * 32}),
    )
    content = image_bytes(image(MACHINES[0]))
    with pytest.raises(DamagedImageError):
        image_from_bytes(content)


def test_another_register_map_is_refused_with_both_hashes(monkeypatch):
    content = image_bytes(image(MACHINES[0]))
    monkeypatch.setattr(register_map, "MAP_SHA256", "77" * 32)
    with pytest.raises(ImageMismatchError):
        image_from_bytes(content)


def test_another_format_is_refused():
    content = image_bytes(image(MACHINES[0]))
    for other, error in (
        (b"BMIMAGE\x09" + content[8:], ImageMismatchError),
        (b"hello" * 20, DamagedImageError),
    ):
        with pytest.raises(error):
            image_from_bytes(other)


def test_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(ImageError):
        read_image(tmp_path / "none.bm")


@pytest.mark.parametrize(
    ("of", "sensors", "results"),
    [
        *((machine(1), *words) for words in ((1, 1200), (20, 7), (0, 10), (65, 10), (10, 0), (10, 4097))),
        (machine(1, replicas=4), 7, 31),
        (machine(1, lines=40, replicas=200, sensor_mode=SensorMode.CELL), 20, 1200),
    ],
)
def test_an_interface_that_the_machine_or_the_map_outgrows_is_refused(of, sensors, results):
    with pytest.raises(ImageError):
        dataclasses.replace(
            image(machine(1)), machine=of, interface_sensors=sensors, interface_results=results
        )


def _section(shape, **others):
    """Return a change of the manifest's first section, whose hash is right where it has no data or one code."""
    data = MACHINES[0].prior.astype("<u2").tobytes()[: 2 * abs(math.prod(shape))]
    changed = {"shape": shape, "sha256": hashlib.sha256(data).hexdigest(), **others}
    return lambda identity: identity["sections"][0].update(changed)


@pytest.mark.parametrize(
    "change",
    [
        _section([0, 10**30]), _section([0, 2**31, 2**31, 2**31]), _section([0, 8]), _section([-1, 8]),
        _section([1] * 100), _section([1, 8], dtype="<u8"), _section([1, 8], dtype="O"),
        _section([1, 8], name="column 1"), lambda identity: identity["sections"].pop(),
        lambda identity: identity["sections"].clear(),
        lambda identity: identity["sections"].append(identity["sections"][0]),
        lambda identity: identity["parameters"].update(lines=2**32 - 1),
        lambda identity: identity["parameters"].update(lines=10**30),
        lambda identity: identity["parameters"].update(sensor_bits=[16] * 1000),
        lambda identity: identity["parameters"].update(prior_bits=16),
        lambda identity: identity["partition"].update(total_lines=10**30),
        lambda identity: identity["interface"].update(results=10**30),
        lambda identity: identity.update(machine="A" * 2000),
        lambda identity: identity.update(map_hash="A" * 2000),
        _section([1, 8], sha256="A" * 2000),
    ],
)  # fmt: skip
def test_a_crafted_manifest_is_refused_before_anything_is_allocated(change):
    """A file whose hashes are right and whose sizes are not those of its parameters."""
    content = image_bytes(image(machine(1)))
    manifest = manifest_of(content)
    change(manifest["identity"])
    manifest["image_hash"] = hashlib.sha256(programming_file._canonical(manifest["identity"])).hexdigest()
    text = programming_file._canonical(manifest)
    header = content[:8] + len(text).to_bytes(4, "little") + bytes(4) + hashlib.sha256(text).digest()
    data = (
        content[48 + int.from_bytes(content[8:12], "little") :] if manifest["identity"]["sections"] else b""
    )
    crafted = header + text + data
    tracemalloc.start()
    try:
        with pytest.raises(ImageError) as caught:
            image_from_bytes(crafted)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("index", "count", "offset", "total"),
    [(1, 1, 0, 8), (-1, 1, 0, 8), (0, 1, 1, 8), (0, 1, -1, 8), (0, 1 << 16, 0, 8)],
)
def test_an_impossible_partition_is_refused(index, count, offset, total):
    with pytest.raises(ImageError):
        image(machine(1), index=index, count=count, offset=offset, total=total)


def test_what_just_fits_is_accepted():
    of = machine(1)
    room = interface_room(BM1.registers(of.parameters))
    last = image(of, index=65534, count=65535, offset=92, total=100)
    assert last.partition.line_offset == 100 - of.parameters.lines
    largest = dataclasses.replace(last, interface_sensors=room[0], interface_results=room[1])
    assert image_from_bytes(image_bytes(largest)).partition == last.partition
    smallest = machine(1, lines=1, sensor_bits=(3,))
    dataclasses.replace(image(smallest), interface_sensors=1, interface_results=1)


def test_tables_of_a_read_image_cannot_be_written():
    found = image_from_bytes(image_bytes(image(MACHINES[0])))
    with pytest.raises(ValueError, match="read-only"):
        found.machine.prior[0, 0] = 1
    assert found.machine.prior.dtype == np.uint16
