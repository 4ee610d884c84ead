"""Hears the posteriors of a stack, wherever it runs, as a command: prints, draws and saves them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from bridge.client import connect
from posteriors.errors import BadResultError, LabelError, NoResultError
from posteriors.listening import posteriors
from posteriors.pairing import FrameOutcome
from posteriors.posterior import MAX_RESULT, RESULTS_TOPIC, Posterior
from services.commands import flags as options
from services.errors import SettingsError
from services.output.posterior_file import ResultFile, open_result_file, record
from services.output.posterior_picture import ROWS, Axis, axes_of, in_colour, picture, printable
from services.settings import LONGEST_S, Settings, load_settings
from services.sockets.serving import deployment_for
from terminal.command_line import CommandLine
from terminal.connection import report_connection
from terminal.output import put_json, say
from terminal.signals import run_async
from toolchain.deployment import Deployment

_QUEUE_SIZE: Final = 1024
"""Frames that may wait for a slow terminal or a slow disk."""
_PICTURES_A_SECOND: Final = 10
_REPLICAS: Final = 4
"""Replicas of which a line says something; a file has all."""
_WORDS: Final = 7
"""Lines of a terminal that are left for what is said beside a picture."""

Show = Callable[[FrameOutcome, list[Axis]], None]


def line(heard: FrameOutcome, axes: list[Axis]) -> str:
    """What is said of one frame."""
    number = "-" if heard.number is None else str(heard.number)
    if not isinstance(heard, Posterior):
        return f"frame {number}: {heard.outcome if heard.outcome.isprintable() else repr(heard.outcome)}"
    if heard.replicas > 1:  # each has a posterior of its own: nothing is to be said of all
        parts = [f"frame {number}: {heard.replicas} replicas"]
        parts += [_of_replica(heard, at, axes[1:]) for at in range(min(heard.replicas, _REPLICAS))]
        if heard.replicas > _REPLICAS:
            parts.append(f"and {heard.replicas - _REPLICAS} more")
    else:
        parts = [f"frame {number}: {_best(heard, axes)}", *_means(heard, axes)]
    if heard.cycles is not None:
        parts.append(f"{heard.cycles} cycles")
    if heard.latency_us is not None:
        parts.append(f"{heard.latency_us / 1000:.2f} ms")
    return "; ".join(parts)


def _best(posterior: Posterior, axes: list[Axis]) -> str:
    best = posterior.best()
    where = ", ".join(f"{printable(axis.label)} {axis.shown(best[axis.label])}" for axis in axes)
    return f"{where} with {posterior.probability:.3g}"


def _means(posterior: Posterior, axes: list[Axis]) -> list[str]:
    """One part of a line, or none where nothing has a mean."""
    numbers = [axis for axis in axes if not axis.has_states]
    mean = posterior.mean() if numbers else {}
    shown = ", ".join(f"{printable(axis.label)} {axis.shown(mean[axis.label])}" for axis in numbers)
    return [f"mean {shown}"] if shown else []


def _of_replica(heard: Posterior, at: int, axes: list[Axis]) -> str:
    try:
        one = heard.replica(at)
    except LabelError:
        return f"replica {at} no posterior"
    return f"replica {at} {_best(one, axes)}"


async def hear(
    settings: Settings,
    deployment: Deployment | None,
    *,
    uri: str,
    topic: str,
    count: int | None,
    silence: float | None,
    show: Show,
    file: ResultFile | None,
) -> int:
    """Show and save frames until so many posteriors have come.

    Raises:
        NoResultError: nothing came in time.
        BadResultError: something else than results came first.
        SettingsError: the posterior is none of the deployment's, or the file cannot be written.
        BridgeError: the server is not there, or is none.
    """
    taken = 0
    told = False
    limit: float = settings.first_data_timeout
    began = False
    async with (
        connect(
            uri,
            connect_timeout=settings.connect_timeout,
            ros_version=settings.ros_version,
            on_state=report_connection(uri),
            max_size=MAX_RESULT,
        ) as ros,
        posteriors(
            ros, topic=topic, deployment=deployment.name if deployment else None, queue_size=_QUEUE_SIZE
        ) as heard,
    ):
        say(f"listening on {topic} at {uri}")
        try:
            while count is None or taken < count:
                try:
                    one = await heard.next_frame(silence if began and silence else limit)
                except NoResultError as error:
                    if not began or silence:
                        raise
                    if not told:
                        say(f"warning: {error}")
                    told = True
                    continue
                except BadResultError as error:
                    if not began:
                        raise
                    say(f"warning: {error}")
                    continue
                began, told = True, False
                axes: list[Axis] = []
                if isinstance(one, Posterior):
                    taken += 1
                    try:
                        axes = axes_of(one, deployment)
                    except ValueError as error:
                        raise SettingsError(str(error)) from error
                if file is not None:
                    file.add(one, axes)
                show(one, axes)
        finally:
            if heard.lost:
                say(f"warning: {heard.lost} were lost: they came faster than they could be shown or saved")
    return 0


def _print_line(heard: FrameOutcome, axes: list[Axis]) -> None:
    print(line(heard, axes), flush=True)


def _print_json(heard: FrameOutcome, axes: list[Axis]) -> None:
    put_json(record(heard, axes))


@contextlib.contextmanager
def _drawing() -> Iterator[Show]:
    """On a terminal one picture that changes, elsewhere one below the other."""
    console = Console(highlight=False, markup=False)
    colour = in_colour(console)
    rows = max(console.height - _WORDS, 2) if console.is_terminal else ROWS

    def drawn(heard: FrameOutcome, axes: list[Axis]) -> Group | Text:
        words = Text(line(heard, axes))
        if not isinstance(heard, Posterior):
            return words
        return Group(words, picture(heard, axes, width=console.width, rows=rows, colour=colour))

    if not console.is_terminal:
        yield lambda heard, axes: console.print(drawn(heard, axes), soft_wrap=True)  # a line stays one
        return
    newest: list[tuple[FrameOutcome, list[Axis]]] = []
    shown = -1.0
    with Live(console=console, auto_refresh=False) as live:

        def show(heard: FrameOutcome, axes: list[Axis]) -> None:
            nonlocal shown
            newest[:] = [(heard, axes)]
            now = time.monotonic()
            if now - shown >= 1 / _PICTURES_A_SECOND:
                shown = now
                live.update(drawn(heard, axes), refresh=True)

        try:
            yield show
        finally:
            for heard, axes in newest:
                live.update(drawn(heard, axes), refresh=True)


app = CommandLine(
    help="Print, draw or save the posteriors of a running stack.\n\n"
    "`listen --uri ws://robot:9090 --count 10`\n\n"
    "With `-d build/boat` cells have values in their units, and the server is the deployment's. `--plot` draws each "
    "posterior in the terminal; `--save posteriors.jsonl` (or .csv, .npz) saves them."
)


@app.command(help=app.info.help)
def listen(
    uri: options.Uri = None,
    deployment: options.Deployment = None,
    topic: Annotated[
        str | None, typer.Option(help="Where the posteriors are (the deployment's, or /BMresults).")
    ] = None,
    count: options.Count = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object a line, with the whole posterior.")
    ] = False,
    plot: Annotated[bool, typer.Option("--plot", help="Draw each posterior in the terminal.")] = False,
    save: Annotated[
        Path | None,
        typer.Option(
            help="Save to this file: .jsonl and .csv are appended to, .npz is made anew.", metavar="FILE"
        ),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=LONGEST_S,
            help="End after so many seconds without a result; by default they are waited out.",
        ),
    ] = None,
    first_data_timeout: options.FirstDataTimeout = None,
    connect_timeout: options.ConnectTimeout = None,
    ros_version: options.RosVersion = None,
) -> int:
    """Print, draw or save the posteriors of a running stack."""
    if as_json and plot:
        msg = "--json and --plot both want the standard output: give one of them"
        raise SettingsError(msg)
    settings = load_settings(
        uri=uri,
        deployment=deployment,
        first_data_timeout=first_data_timeout,
        connect_timeout=connect_timeout,
        ros_version=ros_version,
    )
    loaded = deployment_for(settings) if settings.deployment is not None else None
    output = loaded.outputs[0] if loaded is not None else None
    server = settings.uri or (
        loaded.output_uri(output) if loaded is not None and output is not None else None
    )
    if server is None:
        msg = "give --uri ws://HOST:PORT, or --deployment DIR (listen --help shows examples)"
        raise SettingsError(msg)
    where = topic or (output.topic if output is not None else RESULTS_TOPIC)
    with contextlib.ExitStack() as stack:
        file = open_result_file(save) if save is not None else None
        if file is not None:
            stack.callback(file.close)
        show = stack.enter_context(_drawing()) if plot else _print_json if as_json else _print_line
        return run_async(
            hear(
                settings,
                loaded,
                uri=server,
                topic=where,
                count=count,
                silence=timeout,
                show=show,
                file=file,
            )
        )
