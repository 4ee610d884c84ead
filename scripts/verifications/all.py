"""Everything that can be verified on this machine, one part after the other (see scripts/verify)."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

from scripts.running.flags import ScriptParser
from scripts.running.processes import ROOT

PARTS = {
    "tests": "scripts/test --all",
    "rosbridge": "scripts/verify rosbridge",
    "client": "scripts/verify client",
    "containers": "scripts/verify containers",
    "networks": "scripts/verify networks",
    "hdl": "scripts/verify hdl",
    "resources": "scripts/verify resources",
    "campaign": "scripts/campaign --frames 10000",
}
NOT_HERE = 4
"""Exit code of a part that this machine cannot run; its output says why."""


def run(parts: list[str]) -> int:
    """Run the parts, go on after a failure, print a line for each at the end, and return the exit code."""
    lines, failed = [], []
    for name in parts:
        print(f"== {name}: {PARTS[name]}", flush=True)
        began = time.monotonic()
        code = subprocess.run(PARTS[name].split(), cwd=ROOT, check=False).returncode
        outcome = {0: "ok", NOT_HERE: "skipped, because this machine cannot run it"}.get(
            code, f"failed ({code})"
        )
        lines.append(f"{name}: {outcome}, {time.monotonic() - began:.0f} s")
        if code not in {0, NOT_HERE}:
            failed.append(name)
    print("\n".join(["== all", *lines]))
    if failed:
        print(f"failed: {', '.join(failed)}")
    return 1 if failed else 0


def main() -> int:
    """Run the command."""
    parser = ScriptParser(
        prog="scripts/verify all", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=list(PARTS), help="only this part; repeatable")
    return run(parser.parse_args().only or list(PARTS))


if __name__ == "__main__":
    sys.exit(main())
