"""The commands for a network file: `query` prints posteriors, and `show` lists the variables."""

import re
import sys
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from terminal.output import say_if_slow
from toolchain.building.options import MachineChoice
from toolchain.flags import key_values, names_in
from toolchain.networks import read_network

NetworkPath: TypeAlias = Annotated[
    Path, typer.Argument(help="Network file: .bif, .xmlbif, .uai, .net, .xdsl (.gz).", metavar="NETWORK")
]
Json: TypeAlias = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


def query(
    network: NetworkPath,
    searched: Annotated[str, typer.Option(help="Searched variables.", metavar="A,B")],
    known: Annotated[
        list[str] | None,
        typer.Option(help="A known variable and its state; repeatable.", metavar="NAME=STATE"),
    ] = None,
    machine: Annotated[
        MachineChoice | None,
        typer.Option(help="Also the posterior of a machine; auto: of the one that a build would choose."),
    ] = None,
    best: Annotated[
        bool,
        typer.Option("--map", help="Print only the most probable states of the searched variables together."),
    ] = False,
    json: Json = False,
) -> None:
    """Print the exact posterior of variables of a network and, with --machine, also the posterior of a machine.

    For example `toolchain query asia.bif --searched bronc --known smoke=yes --known dysp=yes --machine auto`
    """
    from toolchain.analysis.query import answer

    # a comma also separates two NAME=STATE, but one inside of a state does not
    settings = [each for text in known or () for each in re.split(r",(?=[^,=]+=)", text)]
    states = key_values(settings, "--known", "smoke=yes")
    names, joint = names_in("--searched", searched), read_network(network)
    with say_if_slow(f"Running the machine of {joint.name}" if machine else f"Summing over {joint.name}"):
        found = answer(joint, names, states, machine)
    text, encoding = found.as_json() if json else found.report(best=best), sys.stdout.encoding
    typer.echo(text.encode(encoding, "replace").decode(encoding), nl=False)  # bars are not ASCII


def show(
    network: NetworkPath,
    searched: Annotated[
        str,
        typer.Option(
            help="Also show which variables a BM1 can know together if these are searched.", metavar="A,B"
        ),
    ] = "",
    known: Annotated[
        str, typer.Option(help="With --searched: only these as known variables.", metavar="A,B")
    ] = "",
    json: Json = False,
) -> None:
    """List the variables and states of a network.

    With --searched, also show which variables can be known variables of the same BM1.

    For example `toolchain show asia.bif --searched bronc`
    """
    from toolchain.analysis.query import contents

    names, candidates = names_in("--searched", searched), names_in("--known", known)
    found = contents(read_network(network), names, candidates)
    typer.echo(found.as_json() if json else found.report(), nl=False)
