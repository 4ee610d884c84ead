"""Files that would block, never end, or take a thousand times their size."""

import json
import os
import zipfile
from pathlib import Path

import pytest

from tests.toolchain.running import refused_within
from toolchain.bounded_files import read_bounded
from toolchain.building.sources import read_sources
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError, DeploymentError, MifError, ModelError, NetworkFileError
from toolchain.learning.fitted import read_fit
from toolchain.learning.recording import read_recording
from toolchain.models.case_study import load_model
from toolchain.networks import read_network
from toolchain.outputs.mif import read_mif

READERS = {
    "x.bif": (read_network, NetworkFileError),
    "x.uai": (read_network, NetworkFileError),
    "x.xdsl": (read_network, NetworkFileError),
    "x.bif.gz": (read_network, NetworkFileError),
    "x.mif": (read_mif, MifError),
    "x.npz": (read_fit, ModelError),
    "fit.toml": (read_fit, ModelError),
    "x.csv": (lambda path: read_recording(path, ["a"]), ModelError),
    "sources.toml": (lambda path: read_sources(path, None), BuildError),
    "deployment.toml": (lambda path: load_deployment(path.parent), DeploymentError),
    "model.py": (lambda path: load_model(path, {}), ModelError),
}


KINDS = {"fifo": os.mkfifo, "endless": lambda path: path.symlink_to("/dev/zero"), "folder": Path.mkdir}


@pytest.mark.parametrize("name", READERS)
def test_nothing_but_a_regular_file_is_read(tmp_path, name):
    read, error = READERS[name]
    with pytest.raises(error):
        read(tmp_path / name)
    for kind, make in KINDS.items():
        (tmp_path / kind).mkdir()
        make(tmp_path / kind / name)
        with pytest.raises(error):
            read(tmp_path / kind / name)


def test_a_file_is_read_up_to_its_bound(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_bounded(path, 5, BuildError) == b"12345"
    with pytest.raises(BuildError):
        read_bounded(path, 4, BuildError)
    with pytest.raises(BuildError):  # a file of /proc says that it is empty
        read_bounded(Path("/proc/self/status"), 4, BuildError)


KEY = "a" + ".a" * 20_000
DEEP_KEYS = {
    "a dotted key": f"{KEY} = 1",
    "an array's header": f"[[{KEY}]]",
    "a quoted key": r'"\""' + KEY[1:] + " = 1",
    "a key with spaces": "  'a' " + KEY[1:].replace(".", " . ") + " = 1",
    "an inline table": f"c = {{a = 1, {KEY} = 1}}",
}


@pytest.mark.parametrize(
    ("text", "line", "megabytes"),
    [
        *(pytest.param(f"b = 1\n{key}", 2, 2, id=kind) for kind, key in DEEP_KEYS.items()),
        *(
            pytest.param(unit * 110_000, ..., 16, id=unit)
            for unit in ("[[source]]\n", "[[a]]\n", "a = 1\n", "a = {}\n")
        ),
        pytest.param("format = 1\nvariable = [" + "{}," * 90_000 + "]\n", ..., 48, id="wrong tables"),
    ],
)
def test_toml_that_would_take_much_memory_is_refused(tmp_path, text, line, megabytes):
    (tmp_path / "deployment.toml").write_text(text)
    with refused_within(megabytes << 20, DeploymentError) as caught:
        load_deployment(tmp_path)
    assert line in {..., caught.value.line}


def test_counted_tables_whose_description_unpacks_to_much_are_refused(tmp_path):
    path = tmp_path / "fit.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("fit.json", json.dumps([[]] * (3 << 20)))
    assert path.stat().st_size < 1 << 20
    with refused_within(16 << 20, ModelError):
        read_fit(path)
