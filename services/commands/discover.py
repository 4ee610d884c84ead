"""The command `discover`."""

import json
import re
import sys
from dataclasses import asdict
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bridge.discovery import ROBOT, Robot, UnknownRobotError
from services.errors import SettingsError
from terminal.command_line import CommandLine
from terminal.one_line import one_line
from terminal.output import say
from terminal.signals import check_signals, run_async

_LONGEST_ANSWER: Final = 80

app = CommandLine(
    help="List the rosbridge servers that announce themselves on this network.\n\n`discover`\n\n"
    "Use a listed name instead of an address with `--uri robot:NAME`, or choose one from the list:\n\n"
    '`master --once -d build/boat --uri "$(discover --pick)"`'
)


@app.command(help=app.info.help)
def discover(
    timeout: Annotated[
        float, typer.Option(min=0.1, max=60, help="Seconds to wait for answers; the whole time is used.")
    ] = 2.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per line instead of a table.")
    ] = False,
    pick: Annotated[
        bool, typer.Option("--pick", help="Ask for the number of a server, and print its robot:NAME.")
    ] = False,
) -> int:
    """List the rosbridge servers that announce themselves on this network."""
    if pick and as_json:
        raise SettingsError("--pick and --json cannot be combined: omit one of them")

    # filled in a coroutine of its own, so that a question to the user does not block an event loop
    robots: list[Robot] = []

    say(f"looking for rosbridge servers on this network for {timeout:g} s ...")

    async def look() -> None:
        from bridge.discovery import discover

        robots.extend(await discover(timeout))

    run_async(look())
    if not robots:
        raise UnknownRobotError(
            f"no rosbridge server announced itself on this network within {timeout:g} s; "
            "the hub does with --announce NAME"
        )
    # the table goes to standard error, because a shell takes standard output as the URI
    if pick:
        Console(stderr=True).print(_table(robots, numbered=True))
        print(f"{ROBOT}{_picked(robots).name}")
    elif as_json:
        for robot in robots:
            print(json.dumps(asdict(robot)))
    else:
        Console().print(_table(robots))
    return 0


def _picked(robots: list[Robot]) -> Robot:
    """Ask the user for the number of a robot and return that robot, or raise a SettingsError."""
    check_signals()
    print(f"number of the server (1 to {len(robots)}): ", end="", file=sys.stderr, flush=True)
    # bounded, because a pipe may send a line without end
    answer = sys.stdin.readline(_LONGEST_ANSWER).strip()
    if not re.fullmatch(r"[0-9]+", answer, re.ASCII) or not 1 <= int(answer) <= len(robots):
        raise SettingsError(f"{answer!r} is not a number from 1 to {len(robots)}; run discover again")
    return robots[int(answer) - 1]


def _table(robots: list[Robot], *, numbered: bool = False) -> Table:
    table = Table()
    for column in (*(("",) if numbered else ()), "name", "URI", "ROS", "token"):
        table.add_column(column, overflow="fold")
    for number, robot in enumerate(robots, start=1):
        # anybody on the network may announce any name
        name, uri = escape(one_line(robot.name)), escape(one_line(robot.uri))
        ros, token = str(robot.ros_version or "?"), "wanted" if robot.token else ""
        table.add_row(*([str(number)] if numbered else []), name, uri, ros, token)
    return table
