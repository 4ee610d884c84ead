"""Runs of the simulator and of the synthesiser."""

import subprocess

LIMIT_S = 240.0
"""For one run of a tool."""


def run(command):
    """Run a tool and return its output; a failure shows its last words."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, f"{command[0]} failed: {(done.stderr or done.stdout).strip()[-400:]}"
    return done.stdout
