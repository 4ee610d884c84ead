"""docs/explanation/house.md and README: paths, functions and rooms are those of the tree."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/explanation/house.md").read_text()
ROOMS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]


def test_every_path_exists():
    paths = set(re.findall(r"`(\w+/[\w./]*)`", PAGE))
    assert len(paths) > 40
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_every_function_of_the_two_paths_exists():
    rows = re.findall(
        r"^\| [^|]+ \| `[^|]+\| (`[^|]+) \|$", PAGE.split("## A reading's path", 1)[1], re.MULTILINE
    )
    names = {name.rsplit(".", 1)[-1] for row in rows for name in re.findall(r"`([\w.]+)`", row)}
    assert len(names) > 20
    sources = "\n".join(path.read_text() for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    assert not [name for name in names if not re.search(rf"\b(def|class) {name}\b", sources)]


def test_every_room_is_on_both_pages():
    readme = (ROOT / "README.md").read_text()
    for room in ROOMS:
        assert f"| `{room}/` |" in PAGE
        assert f"| [`{room}/`]({room}) |" in readme
