"""The bill of materials, and a wheel that has the same bytes wherever it is built; `scripts/verify wheel` runs it."""

import hashlib
import json
import os
import re
import subprocess
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.patience import PROCESS_PATIENCE
from toolchain import hardware

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).resolve().parent.parent
ROOMS = (
    *("rosbayes", "machines", "bridge", "pcie_shim", "posteriors", "terminal", "toolchain", "services"),
    "casestudies",
)


def run(*command, cwd):
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "BM_"))
    }
    return subprocess.run(
        [str(each) for each in command],
        cwd=cwd,
        env=environment,
        check=True,
        timeout=PROCESS_PATIENCE,
        capture_output=True,
        text=True,
    ).stdout


def test_the_bill_has_every_package_that_users_install(tmp_path):
    run(ROOT / "scripts" / "bill-of-materials", tmp_path / "bill.json", cwd=tmp_path)
    bill = json.loads((tmp_path / "bill.json").read_text())
    lines = re.findall(r"^(\S.*?) \\$", (ROOT / "requirements-image.lock").read_text(), re.MULTILINE)
    pins = [each for each in map(Requirement, lines) if each.marker is None or each.marker.evaluate()]
    found = {canonicalize_name(each["name"]): f"=={each['version']}" for each in bill["components"]}
    assert found == {each.name: str(each.specifier) for each in pins}


def test_a_wheel_built_twice_is_the_same_bytes(tmp_path):
    wheels = []
    for umask, zone in (("022", "UTC"), ("077", "Asia/Tokyo")):
        built = tmp_path / umask
        subprocess.run(
            ["bash", "-c", f"umask {umask}; {ROOT}/scripts/wheel '{built}'"],
            check=True,
            timeout=PROCESS_PATIENCE,
            capture_output=True,
            env=os.environ | {"TZ": zone, "PYTHONHASHSEED": umask},
        )
        wheels += built.glob("*.whl")
    digests = {hashlib.sha256(each.read_bytes()).hexdigest() for each in wheels}
    assert (len(wheels), len(digests)) == (2, 1)
    with zipfile.ZipFile(wheels[0]) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    files = run("git", "ls-tree", "-r", "--name-only", "HEAD", *ROOMS, cwd=ROOT).splitlines()
    assert names >= {f"hdl/{each}" for each in hardware.SOURCES} | set(files)
    assert not any(name.startswith(("tests", "scripts", "hdl/test")) for name in names)
