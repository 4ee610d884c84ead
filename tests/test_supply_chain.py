"""The bill of materials, the licences, and a wheel that is the same wherever it is built."""

import hashlib
import json
import os
import re
import subprocess
import zipfile
from pathlib import Path

import pytest

from scripts.supply_chain.bill_of_materials import LicenceError, Package, check, licence_of, locked
from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.thorough
def test_the_bill_has_every_locked_package_with_its_hashes_and_licence(tmp_path):
    bills = []
    for name in ("first", "second"):
        file = tmp_path / name
        subprocess.run(
            [ROOT / "scripts" / "bill-of-materials", "--json", file],
            check=True,
            timeout=PROCESS_PATIENCE,
            capture_output=True,
        )
        bills.append(json.loads(file.read_text()))
    for each in bills:
        del each["metadata"]["timestamp"]
    assert bills[0] == bills[1]
    components = bills[0]["components"]
    required = {(each["name"], each["version"]): each for each in components if each["scope"] == "required"}
    pins = set(re.findall(r"^([\w.-]+)==([\w.]+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE))
    assert set(required) == pins
    hashes = set(re.findall(r"sha256:(\w{64})", (ROOT / "requirements.lock").read_text()))
    assert {each["content"] for one in required.values() for each in one["hashes"]} == hashes
    assert all(one["licenses"][0]["expression"] for one in required.values())
    everything = set(
        re.findall(r"^([\w.-]+)==([\w.]+)", (ROOT / "requirements-dev.lock").read_text(), re.MULTILINE)
    )
    assert {(each["name"], each["version"]) for each in components} == everything | pins


@pytest.mark.parametrize(
    ("licence", "is_allowed"),
    [
        ("MIT", True),
        ("MIT AND BSD-3-Clause", True),
        ("GPL-3.0-only OR MIT", True),
        ("GPL-3.0-only", False),
        ("MIT AND GPL-3.0-only", False),
        ("BSD-3-Clause AND (GPL-3.0-only OR MIT)", True),
    ],
)
def test_one_choice_of_a_licence_must_be_allowed(licence, is_allowed):
    package = Package("package", "1", ())
    if is_allowed:
        check(package, licence, {"MIT", "BSD-3-Clause"})
    else:
        with pytest.raises(LicenceError):
            check(package, licence, {"MIT", "BSD-3-Clause"})


def test_a_licence_is_stated_or_read_but_not_both():
    packages = {each.name: each for each in locked(ROOT / "requirements.lock")}
    assert licence_of(packages["msgspec"], {}) == "BSD-3-Clause"
    assert licence_of(packages["rich"], {"rich": "MIT"}) == "MIT"
    for name, known in (("rich", {}), ("msgspec", {"msgspec": "MIT"})):
        with pytest.raises(LicenceError):
            licence_of(packages[name], known)


@pytest.mark.thorough
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
        assert "services/commands/master.py" in archive.namelist()
        assert not any(name.startswith(("tests", "scripts", "hdl")) for name in archive.namelist())
