"""README.md: its order, and commands that exist with the flags that it gives them."""

import re
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

from rosbayes.__main__ import app

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
IGNORED = {line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines()}


def printed(text):
    """The commands that are printed on a page, without the blocks of other languages."""
    joined = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL).replace("\\\n", " ")
    return re.findall(r"^    (\S.*)$", joined, re.MULTILINE)


def called(line):
    """A printed line's command and its flags; None if it is not one of `rosbayes`."""
    first, *words = shlex.split(line, comments=True)
    group = get_command(app)
    if (name := first.rpartition("/")[2]) not in group.commands:
        return None
    command = group.resolve_command(None, [name])[1]
    if words and words[0] in getattr(command, "commands", {}):
        command = command.commands[words[0]]
    return command, {word for word in words if word.startswith("-")}


CALLS = [pytest.param(*call, id=line) for line in printed(README) if (call := called(line))]


def test_readme_is_in_the_order_in_which_it_works():
    order = ["scripts/demo\n", "--plot", "ws://robot:9090", "docker compose up"]
    assert sorted(order, key=README.index) == order


def test_the_commands_are_found():
    assert len(CALLS) >= 5


@pytest.mark.parametrize(("command", "flags"), CALLS)
def test_a_command_of_readme_takes_the_flags_that_are_printed(command, flags):
    assert flags <= {name for each in command.params for name in (*each.opts, *each.secondary_opts)}


def test_every_script_of_readme_exists():
    scripts = {line.split()[0] for line in printed(README) if line.startswith("scripts/")}
    assert "scripts/demo" in scripts
    assert all((ROOT / script).is_file() for script in scripts)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_no_page_puts_a_model_into_a_folder_that_git_ignores(page):
    for line in printed(page.read_text()):
        words = line.split()
        if words[0] == "toolchain" and words[1] in {"new", "build", "fit", "explore"}:
            assert words[2].partition("/")[0] not in IGNORED, line


def test_the_notebook_of_readme_runs(tmp_path, monkeypatch, capsys):
    (text,) = [
        each
        for each in re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
        if "build/boat" in each
    ]
    (line,) = [each for each in printed(README) if each.startswith("toolchain build casestudies/boat")]
    words = [str(ROOT / word) if word.startswith("casestudies") else word for word in shlex.split(line)[1:]]
    monkeypatch.chdir(tmp_path)
    command = get_command(app).resolve_command(None, ["toolchain"])[1]
    command.main(words, standalone_mode=False)
    capsys.readouterr()
    exec(text, {})  # noqa: S102 - the page's own program
    assert capsys.readouterr().out.startswith("('y', 'x') (32, 32)")
