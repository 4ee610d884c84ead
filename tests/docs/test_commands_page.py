"""docs/reference/commands.md: a row for every script and for every benchmark and verification."""

import os
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/reference/commands.md").read_text()
ROWS = re.findall(r"^\| `(?:\. )?(scripts/[\w-]+(?: [a-z]+)?)", PAGE, re.MULTILINE)


def scripts():
    """The scripts of this folder, each with its names if it runs one of several modules."""
    for path in sorted((ROOT / "scripts").iterdir()):
        if path.is_file() and os.access(path, os.X_OK):
            found = re.search(r"^ +(\w+(?: \| \w+)+)\) exec python", path.read_text(), re.MULTILINE)
            names = [f" {name}" for name in found[1].split(" | ")] if found else [""]
            yield from (f"scripts/{path.name}{name}" for name in names)


def test_every_script_has_a_row():
    # the image's entry point is described on the page about containers
    described = {row if row in set(scripts()) else row.split()[0] for row in ROWS}
    assert set(scripts()) - {"scripts/with-kernels"} <= described
