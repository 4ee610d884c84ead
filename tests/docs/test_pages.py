"""The pages name what exists and what a user can set, and their examples run and give what is printed below them."""

import asyncio
import contextlib
import dataclasses
import doctest
import importlib
import io
import json
import re
import shlex
import tomllib
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from typer.main import get_command

from bridge.client import connect
from bridge.hub.limits import HubLimits
from machines.parameters import BM1Parameters
from machines.posterior import posterior as run_machine
from pcie_shim import errors, framing
from pcie_shim.programming_file import read_image
from rosbayes.__main__ import app
from services.settings import ENV_PREFIX, Settings
from terminal.flags import default_of, field_flag
from tests.bridge.hub.broker_harness import Harness
from tests.bridge.hub.sockets import running_hub
from tests.patience import PATIENCE
from tests.toolchain.running import TARGET, assert_refused, toolchain
from toolchain.building.sources import read_sources
from toolchain.checks.findings import Check
from toolchain.deployment import BM1Section, BM2Section, DeploymentFile, Variable, load_deployment
from toolchain.models.case_study import load_model

ROOT = Path(__file__).parents[2]
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in (ROOT / "docs").rglob("*.md")}
PAGES["README.md"] = (ROOT / "README.md").read_text()
ROOMS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]


# Paths, rooms and scripts


def test_paths_functions_and_rooms_of_the_house_exist():
    page = PAGES["docs/explanation/house.md"]
    paths = set(re.findall(r"`(\w+/[\w./]*)`", page))
    assert len(paths) > 40
    assert not [path for path in paths if not (ROOT / path).exists()]
    ways = page.split("## A reading's path", 1)[1]
    rows = re.findall(r"^\| [^|]+ \| `[^|]+\| (`[^|]+) \|$", ways, re.MULTILINE)
    names = {name.rsplit(".", 1)[-1] for row in rows for name in re.findall(r"`([\w.]+)`", row)}
    assert len(names) > 20
    sources = "\n".join(path.read_text() for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    assert not [name for name in names if not re.search(rf"\b(def|class) {name}\b", sources)]


# Printed commands


def printed(text):
    """The commands that are printed on a page, without the blocks of other languages."""
    joined = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL).replace("\\\n", " ")
    return re.findall(r"^    (\S.*)$", joined, re.MULTILINE)


def test_the_commands_of_readme_and_its_doors_exist_with_their_flags():
    group, checked = get_command(app), 0
    doors = [PAGES[name] for name in PAGES if name.startswith("docs/start/")]
    for line in [line for page in (PAGES["README.md"], *doors) for line in printed(page)]:
        first, *words = shlex.split(line, comments=True)
        if first.startswith("scripts/"):
            assert (ROOT / first).is_file()
        if (name := first.rpartition("/")[2]) not in group.commands:
            continue
        command = group.resolve_command(None, [name])[1]
        if words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words[0]]
        flags = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
        assert {word for word in words if word.startswith("-")} <= flags, line
        checked += 1
    assert checked >= 20


def every_flag(group):
    """The flags of all subcommands, and of theirs."""
    found = set()
    for name in group.commands:
        command = group.resolve_command(None, [name])[1]
        found |= {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
        if hasattr(command, "commands"):
            found |= every_flag(command)
    return found


def test_flags_and_files_on_the_page_about_the_thesis_exist():
    page = PAGES["docs/explanation/thesis.md"]
    flags = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", page))
    assert len(flags) > 20
    assert not flags - every_flag(get_command(app))
    files = set(re.findall(r"`((?:scripts|machines|tests|hdl)/[\w./]*\w)", page))
    assert len(files) > 5
    assert not [file for file in files if not (ROOT / file).exists()]


def test_units_and_settings_of_the_pages_about_operation_are_known():
    text = "".join(PAGES[f"docs/how-to/{name}.md"] for name in ("containers", "hosts", "operating"))
    units = re.findall(r"`/etc/systemd/system/[\w@.-]+`:\n\n```ini\n(.*?)```", text, re.DOTALL)
    assert len(units) == 3
    commands = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for unit in units:
        assert re.search(r"^ExecStart=/opt/rosbayes/.venv/bin/([\w-]+)", unit, re.MULTILINE)[1] in commands
        assert "SuccessExitStatus=143" in unit
    assert set(re.findall(r"\bBM_[A-Z_]+", text)) <= {
        ENV_PREFIX + name.upper() for name in Settings.model_fields
    }


# What a user can set or meet


def documented(page, heading):
    """The names in the first column of the tables of a section."""
    section = re.split(r"\n##+ ", PAGES[f"docs/{page}.md"].split(f"\n## {heading}", 1)[1], maxsplit=1)[0]
    rows = re.findall(r"^\| (`.+?) \|", section, re.MULTILINE)
    return [key for row in rows for key in re.findall(r"`([^`]+)`", row)]


def options_of(*path):
    command = get_command(app).resolve_command(None, ["toolchain"])[1]
    for name in path:
        command = command.commands[name]
    names = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return {name for name in names if name.startswith("-")} - {"--help", "-h"}


def sections():
    """The keys of each section of deployment.toml."""
    plain = []
    for name, field in DeploymentFile.model_fields.items():
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [each for each in inner if isinstance(each, type) and issubclass(each, BaseModel)]
        key = str(field.validation_alias or name)
        if name == "machine":
            yield "`[machine]`\n", list(BM1Section.model_fields)
            yield "`[machine]` of a BM2", list(BM2Section.model_fields)
        elif models:
            single = inner[0] is models[0] or type(None) in inner
            yield f"`[{key}]`" if single else f"`[[{key}]]`", list(models[0].model_fields)
        else:
            plain.append(key)
    yield "Top level", plain


def test_every_key_of_the_deployment_is_described():
    for heading, keys in sections():
        assert sorted(documented("reference/deployment", heading)) == sorted(keys)


def test_every_option_of_the_toolchain_is_described():
    for command, page, heading in (
        ("build", "reference/toolchain", "Options"),
        ("fit", "how-to/models", "6. Learning the tables"),
    ):
        assert {key.split(" ")[0] for key in documented(page, heading)} == options_of(command)
    section = PAGES["docs/reference/toolchain.md"].split("\n## One part again", 1)[1].split("\n## ", 1)[0]
    question = {"--set", "--searched", "--known", "--given", "--prior-select", "--previous", "--on-missing"}
    options = set().union(*(options_of("regenerate", part) for part in ("memories", "project", "deployment")))
    assert not {name for name in options - question if name not in section}


def test_every_check_and_parameter_is_described():
    assert set(documented("reference/toolchain", "Checks before anything runs")) == set(Check) - {Check.RNG}
    for field in dataclasses.fields(BM1Parameters):
        assert f"| `{field.name}` |" in PAGES["docs/reference/machines.md"]


def test_every_limit_and_service_of_the_hub_is_described():
    services = Harness().connect().rosapi("node_details", node="/rosapi")["services"]
    assert services
    limits = [field.name for field in dataclasses.fields(HubLimits)]
    for name in (*limits, *(service.removeprefix("/rosapi/") for service in services)):
        assert f"`{name}`" in PAGES["docs/how-to/hub.md"]


def test_every_error_and_operation_of_a_board_is_described():
    page = PAGES["docs/reference/boards.md"]
    for base in (errors.LinkError, errors.AccessError, errors.ImageError):
        for error in base.__subclasses__():
            assert f"| `{error.__name__}` | {error.exit_code} |" in page
    for name in ("GREET", "READ", "WRITE", "IRQ", "ERROR", "PROGRAM"):
        assert f"| {getattr(framing, name)} {name} |" in page


COMMANDS = (
    *("master", "subscriber", "publisher", "pcie_app", "board", "loader", "hub", "listen"),
    *("dashboard", "status"),
)
OTHERS = {"hub": {"ros_version", "message_bytes"}, "board": {"boards"}}
"""Flags of a command that are not settings, but have the name of one."""


def flags_of(name):
    command = get_command(importlib.import_module(f"services.commands.{name}").app)
    return {flag.name for flag in command.params} - OTHERS.get(name, set())


def row(name):
    """The row of a setting, as the page has to contain it."""
    commands = [each.replace("_", "-") for each in COMMANDS if name in flags_of(each)]
    flags = field_flag(Settings, name).names or ("--" + name.replace("_", "-"),)
    cells = (
        f"`{ENV_PREFIX}{name.upper()}`",
        ", ".join(f"`{flag}`" for flag in flags) if commands else "",
        default_of(Settings, name),
        Settings.model_fields[name].description,
        ", ".join(commands),
    )
    return " | ".join(("", *cells, "")).strip().replace("|  ", "| ")


@pytest.mark.parametrize("name", Settings.model_fields)
def test_a_setting_has_the_row_of_its_declaration(name):
    assert row(name) in PAGES["docs/reference/commands.md"].splitlines()


GUIDE = "\n".join(text for name, text in sorted(PAGES.items()) if name.startswith("docs/how-to/bridge"))
EXAMPLES = dict(
    re.findall(r"^###? ([^\n]+)\n(?:(?!^##).)*?^```python\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
)
STARTS = re.findall(r"(?:^    |with\s`)hub(?: --ros-version (\d))?(?:`|$)", GUIDE, re.MULTILINE)
"""ROS versions of the hubs that the pages start for their examples."""
(ROS_VERSION,) = {int(number) for number in STARTS}

Company = Callable[[str], Awaitable[None]]


async def run(example: str, uri: str, company: Company | None = None) -> str:
    """Return the output of an example, run in a thread while `company` acts as the robot."""
    program = compile(example.replace("ws://127.0.0.1:9090", uri), "example.py", "exec")
    said = io.StringIO()

    def play() -> None:
        with contextlib.redirect_stdout(said):
            exec(program, {"__name__": "__main__"})  # noqa: S102  # the pages of this repository

    robot = asyncio.create_task(company(uri)) if company is not None else None
    with ThreadPoolExecutor(1) as thread:
        try:
            await asyncio.get_running_loop().run_in_executor(thread, play)
        finally:
            if robot is not None:
                robot.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await robot
    return said.getvalue()


def publishes(topic: str, type_name: str, *messages: dict[str, Any]) -> Company:
    """Publishes these again and again, until the example has had enough."""

    async def play(uri: str) -> None:
        async with connect(uri) as ros:
            publication = await ros.advertise(topic, type_name)
            while True:
                for message in messages:
                    await publication.publish(message)
                    await asyncio.sleep(0.05)

    return play


poses = publishes("/pose", "geometry_msgs/PointStamped", {"point": {"x": 0.8}}, {"point": {"x": 0.9}})

#: By heading: who plays the robot, and what is printed.
PLAYED: dict[str, tuple[Company | None, str]] = {
    "Subscribe": (poses, "/pose {'x': 0.9,"),
    "A misspelt field": (None, "has no field lineer; did you mean linear"),
    "Long arrays": (None, "0.5 float64"),
    "Large messages": (None, "{'data': 'short'} discarded: 1\na message of /notes cannot be published"),
    "Serialised messages": (None, "laser [0.5 1.5]"),
    "Actions": (None, "no result: action /fibonacci"),
    "Services": (None, "{'sum': 3}\nservice /add at ws://"),
    "Serve an action": (None, "SUCCEEDED {'sequence': [0, 1, 1, 2, 3, 5]}"),
    "Topics, types and parameters": (None, "geometry_msgs/msg/Twist ['/client_"),
    "Threads": (None, "{'data': 'from a thread'}"),
    "Find a variable in messages": (
        None,
        "D1 (True, 7)\ny (True, 2.5)\npose.position.x (True, 1.5)\nranges[1] (True, 0.5)\ndata[2] (True, 3)\n",
    ),
    "Several robots": (poses, "two {'x': 0.9,"),
    "Quality of service (ROS 2)": (None, "{'data': 'here be dragons'}"),
}
ELSEWHERE = {"Publish", "TLS and tokens", "roslibpy"}
"""Examples that have a test of their own, or need a certificate or a process."""


@pytest.mark.parametrize("heading", PLAYED)
async def test_an_example_runs(heading):
    company, printed = PLAYED[heading]
    async with running_hub(ros_version=ROS_VERSION) as port:
        assert printed in await run(EXAMPLES[heading], f"ws://127.0.0.1:{port}", company)


async def test_what_is_published_is_heard():
    async with running_hub(ros_version=ROS_VERSION) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        poses = ros.subscribe("/pose", "geometry_msgs/PointStamped")
        await ros.call("/rosapi/get_time", timeout=PATIENCE)
        await run(EXAMPLES["Publish"], ros.uri)
        heard = [(await poses.next(PATIENCE)).msg["point"]["x"] for _ in range(10)]
        assert heard == [0.1 * step for step in range(10)]


def test_no_example_is_left_out():
    assert set(EXAMPLES) == set(PLAYED) | ELSEWHERE
    assert len(EXAMPLES) == GUIDE.count("```python")


# The exercises, and the page about machines


def test_the_program_of_the_exercises_prints_what_is_below_it(tmp_path, monkeypatch, capsys):
    page = PAGES["docs/start/teaching.md"]
    ((text, answer),) = re.findall(r"^```python\n(.*?)^```.*?^```\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (line,) = [each for each in printed(page) if each.startswith("toolchain build casestudies/boat")]
    words = [str(ROOT / word) if word.startswith("casestudies") else word for word in shlex.split(line)[1:]]
    monkeypatch.chdir(tmp_path)
    command = get_command(app).resolve_command(None, ["toolchain"])[1]
    command.main(words, standalone_mode=False)
    capsys.readouterr()
    exec(text, {})  # noqa: S102 - the page's own program
    assert capsys.readouterr().out == answer


@pytest.mark.parametrize("page", ["machines.md", "bm2.md"])
def test_the_examples_of_machines(page):
    # Fences would be taken for output.
    text = PAGES[f"docs/reference/{page}"].replace("```python\n", "\n").replace("```\n", "\n")
    test = doctest.DocTestParser().get_doctest(text, {}, page, page, 0)
    assert len(test.examples) > 8
    report = []
    doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not report, "".join(report)


# The toolchain's pages

DEPLOYMENT, MODELS, TOOLCHAIN = (
    PAGES[f"docs/{name}.md"] for name in ("reference/deployment", "how-to/models", "reference/toolchain")
)


def test_the_example_is_a_model(tmp_path):
    example = re.search(r"```python\n(.*?)```", TOOLCHAIN, re.DOTALL)[1]
    (tmp_path / "model.py").write_text(example)
    model = load_model(tmp_path, {"cells": "7"})
    assert model.lines == 7
    assert [known.name for known in model.known] == ["range", "door"]


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", MODELS, re.DOTALL)


def test_the_models_page_works_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    models = tmp_path / "models"
    for name in ("mymodel", "boiler"):
        (models / name).mkdir(parents=True)
    texts = (*blocks("bif"), *blocks("csv"))
    for name, text in zip(("garden.bif", "umbrella.bif", "mymodel/walks.csv"), texts, strict=True):
        (models / name).write_text(text)
    boiler, *_ = blocks("python")
    (models / "boiler" / "model.py").write_text(boiler)
    commands = re.findall(r"^    (toolchain .*)$", MODELS, re.MULTILINE)
    assert len(commands) == 13
    for command in commands:
        if "fit=" in command:  # of a model that the reader has changed
            continue
        result = toolchain(*shlex.split(command)[1:])
        assert result.exit_code == 0, f"{command}\n{result.stderr}"
    (days,) = re.findall(r"```text\n(umbrella .*?)```", MODELS, re.DOTALL)
    umbrella = load_deployment(Path("build/umbrella"))
    own, machine = umbrella.new_filter(), read_image(umbrella.image_path(0)).machine
    for number, line in enumerate(days.splitlines(), start=1):
        codes = own.predict()
        address = int(line.startswith("umbrella no"))
        own.update(
            run_machine(machine, [address], prior_codes=codes, bank=number % umbrella.machine.rng_banks)
        )
        assert line.endswith(f"rain {own.belief[0]:.2f}")


def test_the_sources_of_the_deployment_page(tmp_path):
    (example,) = re.findall(r"^```toml\n(.*?)^```", DEPLOYMENT, re.MULTILINE | re.DOTALL)
    (tmp_path / "sources.toml").write_text(example)
    file = read_sources(tmp_path / "sources.toml", "ws://robot:9090")
    names = ("ahead", "colour", "left", "near", "turn")
    placed = file.place(tuple(Variable(name=name, bits=3, values=4) for name in names))
    assert [each.source for each in placed] == [1, 3, 1, 0, 2]


@pytest.mark.parametrize("mode", ["cell", "threshold"])
def test_inspect_explains_the_disparity_model(tmp_path, mode):
    (example,) = re.findall(r"```python\n(# disparity/model\.py.*?)```", TOOLCHAIN, re.DOTALL)
    model, out = tmp_path / "disparity", tmp_path / "out"
    model.mkdir()
    (model / "model.py").write_text(example)
    built = toolchain("build", model, "-o", out, *TARGET, "--sensor-mode", mode, "--replicas", 3)
    assert built.exit_code == 0, built.output
    looked = toolchain("inspect", out, "--frames", 5)
    if mode == "threshold":
        assert_refused(looked, "--model")
    else:
        assert looked.exit_code == 0, looked.output
        assert "5 frames of readings for 3 replicas, drawn from" in looked.stdout
    named = toolchain("inspect", out, "--frames", 5, "--model", model, "--json")
    assert named.exit_code == 0, named.output
    # lines that all read the same would have nothing to be wrong about
    assert 0.001 < json.loads(named.stdout)["accuracy"]["machine"]["total_variation"]["value"] < 0.1
    assert_refused(toolchain("inspect", out, "--readings", tmp_path / "r.csv"), "r.csv")
