"""A run of the tests that is ended by SIGTERM leaves no process behind."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).parents[1]

STARTS_A_HUB = """
import subprocess, time
from pathlib import Path
import pytest

@pytest.mark.thorough
def test_something():
    hub = subprocess.Popen(["{hub}", "--port", "0"], start_new_session=True)
    Path("{pid}.new").write_text(str(hub.pid))
    Path("{pid}.new").rename("{pid}")
    time.sleep(300)
"""


@pytest.mark.parametrize(
    "workers",
    [pytest.param("0", marks=pytest.mark.process), pytest.param("1", marks=pytest.mark.thorough)],
)
def test_a_run_that_is_ended_leaves_nothing(tmp_path, workers):
    pid = tmp_path / "pid"
    test = tmp_path / "test_hub.py"
    test.write_text(STARTS_A_HUB.format(hub=Path(sys.executable).with_name("hub"), pid=pid))
    command = [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-n", workers, str(test)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL) as run:
        deadline = time.monotonic() + PROCESS_PATIENCE
        while not pid.exists():
            assert run.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        run.send_signal(signal.SIGTERM)
        assert run.wait(PROCESS_PATIENCE) == -signal.SIGTERM
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(int(pid.read_text())).wait(PROCESS_PATIENCE)
