"""Files that would block, never end, or take a thousand times their size."""

import json
import os
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from toolchain.building.sources_file import read_sources
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError, DeploymentError, MifError, ModelError, NetworkFileError
from toolchain.files.bounded_file import read_bounded
from toolchain.learning.fitted import read_fit
from toolchain.learning.recording import read_recording
from toolchain.models.case_study import load_model
from toolchain.networks import read_network
from toolchain.outputs.mif import read_mif

READERS = {
    "x.bif": (read_network, NetworkFileError),
    "x.uai": (read_network, NetworkFileError),
    "x.mif": (read_mif, MifError),
    "x.npz": (read_fit, ModelError),
    "fit.toml": (read_fit, ModelError),
    "x.csv": (lambda path: read_recording(path, ["a"]), ModelError),
    "sources.toml": (lambda path: read_sources(path, None), BuildError),
    "deployment.toml": (lambda path: load_deployment(path.parent), DeploymentError),
    "model.py": (lambda path: load_model(path, {}), ModelError),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["fifo", "endless", "folder", "absent"])
def test_nothing_but_a_regular_file_is_read(tmp_path, name, kind):
    read, error = READERS[name]
    path = tmp_path / name
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "endless":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(error):
        read(path)


def test_a_file_is_read_up_to_its_bound(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_bounded(path, 5, BuildError) == b"12345"
    with pytest.raises(BuildError):
        read_bounded(path, 4, BuildError)
    with pytest.raises(BuildError):  # a file of /proc says that it is empty
        read_bounded(Path("/proc/self/status"), 4, BuildError)


KEY = ".a" * 32
HOSTILE_TOML = {
    "a dotted key": f"b\n{KEY[1:]}{KEY * 600} = 1".replace("b\n", "b = 1\n"),
    "a header": f"b = 1\n[{KEY[1:]}{KEY * 600}]",
    "an array's header": f"b = 1\n[[{KEY[1:]}{KEY * 600}]]",
    "a quoted key": "b = 1\n" + r'"\""' + KEY * 600 + " = 1",
    "a key with spaces": "b = 1\n  'a' " + KEY.replace(".", " . ") * 600 + " = 1",
    "an inline table": f"b = 1\nc = {{a = 1, {KEY[1:]}{KEY * 600} = 1}}",
    "a table in an array": f"b = 1\nc = [{{{KEY[1:]}{KEY * 600} = 1}}]",
}


@pytest.mark.parametrize("kind", HOSTILE_TOML)
def test_a_deep_key_is_refused_before_it_is_parsed(tmp_path, kind):
    (tmp_path / "deployment.toml").write_text(HOSTILE_TOML[kind])
    tracemalloc.start()
    try:
        with pytest.raises(DeploymentError) as caught:
            load_deployment(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    assert caught.value.line == 2


@pytest.mark.parametrize("unit", ["[[source]]\n", "[[a]]\n", "a = 1\n", "a = {}\n"])
def test_more_tables_and_keys_than_any_deployment_has_are_refused(tmp_path, unit):
    (tmp_path / "deployment.toml").write_text(unit * 110_000)
    tracemalloc.start()
    try:
        with pytest.raises(DeploymentError):
            load_deployment(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


def test_a_thousand_wrong_tables_are_one_mistake(tmp_path):
    (tmp_path / "deployment.toml").write_text("format = 1\nvariable = [" + "{}," * 90_000 + "]\n")
    tracemalloc.start()
    try:
        with pytest.raises(DeploymentError):
            load_deployment(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 48 << 20
    finally:
        tracemalloc.stop()


def test_counted_tables_whose_description_unpacks_to_much_are_refused(tmp_path):
    path = tmp_path / "fit.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("fit.json", json.dumps([[]] * (3 << 20)))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(ModelError):
            read_fit(path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()
