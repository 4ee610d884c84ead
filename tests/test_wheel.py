"""The wheel on another computer: its commands and packages run in an environment without this folder."""

import json
import os
import site
import subprocess
import sys
from pathlib import Path

import pytest

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
