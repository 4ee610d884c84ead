"""The bill of materials, and a wheel that has the same bytes wherever it is built and runs elsewhere."""

import hashlib
import json
import os
import re
import site
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.patience import PROCESS_PATIENCE
from toolchain import hardware

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).resolve().parent.parent


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
        assert "services/commands/master.py" in archive.namelist()
        assert {f"hdl/{each}" for each in hardware.SOURCES} <= set(archive.namelist())
        assert not any(name.startswith(("tests", "scripts", "hdl/test")) for name in archive.namelist())


def test_an_installed_wheel_has_commands_and_packages(tmp_path):
    """In an environment with the wheel; other packages are those of this one."""
    run(ROOT / "scripts" / "wheel", tmp_path / "dist", cwd=tmp_path)
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv", cwd=tmp_path)
    scripts = tmp_path / "venv" / "bin"
    (wheel,) = (tmp_path / "dist").glob("rosbayes-*.whl")
    install = ("-m", "pip", "--python", scripts / "python", "install", "--no-index", "--no-deps", wheel)
    run(sys.executable, *install, cwd=tmp_path)
    (packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    # a folder that a .pth file names has its own .pth files ignored: this tree, installed editable, stays out
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    assert "--plot" in run(scripts / "listen", "--help", cwd=tmp_path)
    assert "listen" in run(scripts / "rosbayes", "--help", cwd=tmp_path)
    run(scripts / "toolchain", "new", "corridor", cwd=tmp_path)
    target = ("--uri", "ws://127.0.0.1:9090", "--topic", "/corridor/readings", "--type", "a/B")
    run(scripts / "toolchain", "build", "corridor", "-o", "built", *target, cwd=tmp_path)
    assert (tmp_path / "built" / "deployment.toml").is_file()
    code = "import bridge.client, posteriors; print(bridge.client.__file__, posteriors.__file__, sep='\\n')"
    files = run(scripts / "python", "-c", code, cwd=tmp_path).split()
    assert all(Path(each).is_relative_to(tmp_path / "venv") for each in files)
