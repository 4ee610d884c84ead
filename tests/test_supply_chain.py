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
    lines = re.findall(r"^(\S.*?) \\$", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
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
        assert not any(name.startswith(("tests", "scripts", "hdl")) for name in archive.namelist())


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """An environment with the wheel installed; other packages are those of this one."""
    folder = tmp_path_factory.mktemp("elsewhere")
    run(ROOT / "scripts" / "wheel", folder / "dist", cwd=folder)
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    python = folder / "venv" / "bin" / "python"
    (wheel,) = (folder / "dist").glob("rosbayes-*.whl")
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--no-index",
        "--no-deps",
        wheel,
        cwd=folder,
    )
    (packages,) = (folder / "venv" / "lib").glob("python*/site-packages")
    # a folder that a .pth file names has its own .pth files ignored: this tree, installed editable, stays out
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    return folder


def test_its_commands_answer(elsewhere):
    scripts = elsewhere / "venv" / "bin"
    assert "--plot" in run(scripts / "listen", "--help", cwd=elsewhere)
    assert "listen" in run(scripts / "rosbayes", "--help", cwd=elsewhere)
    run(scripts / "toolchain", "new", "corridor", cwd=elsewhere)
    target = [
        "--uri",
        "ws://127.0.0.1:9090",
        "--topic",
        "/corridor/readings",
        "--type",
        "std_msgs/Float64MultiArray",
    ]
    run(scripts / "toolchain", "build", "corridor", "-o", "built", *target, cwd=elsewhere)
    assert (elsewhere / "built" / "deployment.toml").is_file()


def test_its_packages_are_importable(elsewhere):
    code = "import json, bridge.client, posteriors; print(json.dumps([bridge.client.__file__, posteriors.__file__]))"
    files = json.loads(run(elsewhere / "venv" / "bin" / "python", "-c", code, cwd=elsewhere))
    assert all(Path(each).is_relative_to(elsewhere / "venv") for each in files)
