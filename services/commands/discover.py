"""The command `discover`."""

import json
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bridge.discovery import Robot, UnknownRobotError
from terminal.command_line import CommandLine
from terminal.one_line import one_line
from terminal.signals import run_async

app = CommandLine(
    help="List the rosbridge servers that announce themselves on this network.\n\n`discover`\n\n"
    "Use a listed name instead of an address with `--uri robot:NAME`."
)


@app.command(help=app.info.help)
def discover(
    timeout: Annotated[
        float,
        typer.Option(min=0.1, max=60, help="Seconds to wait for answers; the whole time is used."),
    ] = 2.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per line instead of a table.")
    ] = False,
) -> int:
    """List the rosbridge servers that announce themselves on this network."""

    async def look() -> int:
        from bridge.discovery import discover

        robots = await discover(timeout)
        if as_json:
            for robot in robots:
                print(
                    json.dumps(
                        {
                            "name": robot.name,
                            "uri": robot.uri,
                            "ros_version": robot.ros_version,
                            "token": robot.token,
                        }
                    )
                )
        elif robots:
            Console().print(_table(robots))
        if not robots:
            raise UnknownRobotError(
                f"no rosbridge server announced itself on this network within {timeout:g} s; the hub does with --announce NAME"
            )
        return 0

    return run_async(look())


def _table(robots: list[Robot]) -> Table:
    table = Table()
    for column in ("name", "URI", "ROS", "token"):
        table.add_column(column, overflow="fold")
    for robot in robots:
        token = "wanted" if robot.token else ""
        table.add_row(
            escape(one_line(robot.name)), escape(one_line(robot.uri)), str(robot.ros_version or "?"), token
        )
    return table
