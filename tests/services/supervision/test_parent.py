"""Children of a killed parent end."""

import os
import select
import subprocess
import sys
import time

import pytest

from tests.patience import PROCESS_PATIENCE


@pytest.mark.process
def test_a_child_ends_when_its_parent_is_killed(tmp_path):
    child_code = (
        "import time; from services.supervision.parent import end_with_parent; end_with_parent();"
        f"open({str(tmp_path / 'up')!r}, 'w').close(); time.sleep(1000)"
    )
    parent_code = f"""
import asyncio, sys, time
from services.supervision.child import Child

async def main():
    one = Child("tester", [sys.executable, "-c", {child_code!r}])
    await one.start()
    print(one.pid, flush=True)
    await asyncio.sleep(1000)

asyncio.run(main())
"""
    with subprocess.Popen([sys.executable, "-c", parent_code], stdout=subprocess.PIPE, text=True) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        deadline = time.monotonic() + PROCESS_PATIENCE
        while not (tmp_path / "up").exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        parent.kill()
    try:
        assert select.select([child], [], [], PROCESS_PATIENCE)[0], "the child outlived its parent"
    finally:
        os.close(child)
