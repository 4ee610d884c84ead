"""The command `demo`, which runs a case study. It starts the processes in order, and ends them together."""

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Annotated, Any, Final, Literal

import typer

from casestudies import DEFAULT_URI
from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from casestudies.boat.viewer import CLOCK_HZ, Clock
from machines import warm_up
from terminal.command_line import CommandLine
from terminal.errors import OutputError
from terminal.output import check_writable
from terminal.processes import Process, Screen
from terminal.signals import run_async

FIRST_TIMEOUT: Final = 180.0
"""Timeout in seconds of the viewer's first result. It includes building the deployment and compiling kernels."""
PORT: Final = "9090"
"""Port of the hub in a demo that runs until Ctrl-C."""
FIRST_RESULT: Final = r"^ *[0-9]+ "
"""Pattern of the line that a viewer prints for a frame."""

app = CommandLine()


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A case study for the demo, with options of the commands. The demo adds `--uri` and other common options."""

    name: str
    topic: str
    type: str
    boards: int
    options: Sequence[str] = ()
    """Options of the build."""
    pointer: str = ""
    """Advice that is printed after the address of the dashboard's page, or empty."""
    viewer: str
    viewing: Sequence[str] = ()
    """Options of the viewer."""
    publishers: Mapping[str, Sequence[str]]
    """The commands that act as the robot, each with its options, in the order in which they are started."""
    counts_frames: bool = True
    """True if the viewer shows every frame of the master. The demo then passes `--count` to the master as well."""


def boat(rates: Sequence[str], clock: float, *, array: bool) -> Case:
    """Return the boat on four boards. With `array`, the readings are std_msgs/Float64MultiArray."""
    flags = ["--array"] if array else []
    return Case(
        name="boat",
        topic=SENSORS_TOPIC,
        type="std_msgs/Float64MultiArray" if array else SENSORS_TYPE,
        boards=4,
        options=("--set", "array=true") if array else (),
        pointer="; on the page, drag the boat",
        viewer="boat-viewer",
        viewing=("--clock", str(clock)),
        publishers={"boat-normaliser": flags, "boat-simulator": [*rates, *flags]},
    )


def sprinkler(rates: Sequence[str], count: int) -> Case:
    """Return the sprinkler on a BM2 of two boards, with one chain each.

    In a run of at most 256 frames, each frame has its own bank of seeds, so no two frames use the same random numbers.
    """
    options = {"machine": "bm2", "samples": 50_000, "stream": 4096, "rng-banks": min(max(count, 16), 256)}
    return Case(
        name="sprinkler",
        topic="/sprinkler/grass",
        type="std_msgs/UInt8",
        boards=2,
        options=[text for name, value in options.items() for text in (f"--{name}", str(value))],
        viewer="sprinkler-viewer",
        publishers={"sprinkler-garden": rates},
    )


def disparity(rates: Sequence[str]) -> Case:
    """Return binocular disparity on one board, with a replica of the machine for each of 160 pixels."""
    options = {"sensor-mode": "threshold", "replicas": 160, "queue": "all", "max-cycles": 8192}
    return Case(
        name="disparity",
        topic="/disparity/likelihoods",
        type="disparity_msgs/Likelihoods",
        boards=1,
        options=[text for name, value in options.items() for text in (f"--{name}", str(value))],
        viewer="disparity-matcher",
        publishers={"disparity-cameras": rates},
        counts_frames=False,
    )


async def build(
    case_study: str, deployment: Path, uri: str, topic: str, type_: str, *options: str, boards: int = 4
) -> None:
    """Build a case study's deployment, and write the toolchain's output to DEPLOYMENT.log next to it.

    Raises:
        ProcessError: The toolchain failed.
    """
    toolchain = Process("toolchain", deployment.with_name(deployment.name + ".log"), forks=True)
    await toolchain.start(
        *("toolchain", "build", str(Path(__file__).with_name(case_study)), "-o", str(deployment)),
        *("--partitions", str(boards), "--uri", uri, "--topic", topic, "--type", type_, *options),
    )
    await toolchain.succeed()


@app.command()
def demo(
    is_sprinkler: Annotated[
        bool, typer.Option("--sprinkler", help="Run the sprinkler instead, on two BM2.")
    ] = False,
    is_disparity: Annotated[
        bool, typer.Option("--disparity", help="Run binocular disparity instead, on a board of 160 BM1.")
    ] = False,
    uri: Annotated[
        str | None,
        typer.Option(
            help="A rosbridge server.", metavar="ws://HOST:PORT|robot:NAME", show_default="the embedded hub"
        ),
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 25,
    stay: Annotated[
        bool,
        typer.Option(
            "--stay",
            help=f"Run until Ctrl-C, with the hub on port {PORT}, so that `listen` and others can connect.",
        ),
    ] = False,
    dashboard: Annotated[
        bool,
        typer.Option(
            "--dashboard", help="Run until Ctrl-C, as --stay, with a page in the browser on --page-port."
        ),
    ] = False,
    page_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 selects a free one.")
    ] = 8080,
    link_rate: Annotated[
        Literal["none", "pcie-gen2", "jtag"] | None,
        typer.Option(help="Link to the boards (see `board`).", show_default="BM_LINK_RATE, or none"),
    ] = None,
    clock: Clock = CLOCK_HZ,
    rate: Annotated[
        float | None,
        typer.Option(min=0.01, max=10_000, help="Readings per second.", show_default="10, or 2 stereo pairs"),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of what is simulated.", show_default="a new one each time")
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder for the pictures, the deployment and logs.", metavar="DIR")
    ] = Path("out"),
) -> int:
    """Run a case study from end to end, with a simulated robot. Without a flag for another case study, run the boat."""
    if dashboard and find_spec("nicegui") is None:
        raise OutputError(
            "--dashboard needs NiceGUI, which is not installed: pip install 'rosbayes[dashboard]', or leave it out"
        )
    if is_sprinkler and is_disparity:
        raise typer.BadParameter("choose one of --sprinkler and --disparity")
    stay |= dashboard
    if stay and uri is None:
        _check_port("hub", int(PORT), f"use that server with --uri ws://127.0.0.1:{PORT}")
    if dashboard:
        # checked now, because the page is started last
        _check_port("page", page_port, "choose another --page-port")
    check_writable(out)
    rate = rate or (2.0 if is_disparity else 10.0)
    rates = ["--rate", str(rate), *(() if seed is None else ("--seed", str(seed)))]
    # a real server accepts only installed message types
    case = boat(rates, clock, array=uri is not None)
    if is_sprinkler:
        case = sprinkler(rates, count)
    elif is_disparity:
        case = disparity(rates)
    port = page_port if dashboard else None
    link = () if link_rate is None else ("--link-rate", link_rate)
    return run_async(_run(case, uri, None if stay else count, out.resolve(), page_port=port, options=link))


def _check_port(whose: str, port: int, otherwise: str) -> None:
    """Raise an OutputError if a port cannot be listened on."""
    try:
        socket.create_server(("127.0.0.1", port)).close()
    except OSError as error:
        raise OutputError(
            f"the {whose} cannot listen on port {port} ({os.strerror(error.errno or 0)}): end the process that listens there, "
            f"or {otherwise}"
        ) from None


async def _load_kernels() -> None:
    """Load the kernels of the emulated boards in a thread.

    Master and boards are forked from this process, so they inherit the loaded kernels.
    """
    loop, loaded = asyncio.get_running_loop(), asyncio.Event()

    def load() -> None:
        try:
            warm_up()  # boards report its errors
        finally:
            with contextlib.suppress(RuntimeError):  # the demo was ended meanwhile
                loop.call_soon_threadsafe(loaded.set)

    # unlike that of an executor, this thread does not delay Ctrl-C
    Thread(target=load, daemon=True).start()
    await loaded.wait()


def _ends(case: Case, count: int | None, master: Process, viewer: Process) -> list[asyncio.Future[Any]]:
    """Return futures of the events that end a demo: the exits of master and viewer.

    If the master does not count frames, the viewer's last line is a third such event.
    """
    ends: list[asyncio.Future[Any]] = [asyncio.ensure_future(each.succeed()) for each in (master, viewer)]
    if count is not None and not case.counts_frames:
        ends.append(asyncio.ensure_future(viewer.line(rf"^ *{count} ")))
    return ends


async def _run(
    case: Case,
    uri: str | None,
    count: int | None,
    out: Path,
    *,
    page_port: int | None,
    options: Sequence[str],
) -> int:
    """Build, start everything, wait until the viewer has drawn its pictures, and end everything.

    Without a count, run until Ctrl-C. `options` are options of the master.
    """
    started = time.monotonic()
    screen = Screen()
    # the page shows what the viewer prints, whose lines would hide the page's address
    shown = {case.viewer, "master"} if page_port is None else {"master"}
    processes = {
        name: Process(name, out / f"{name}.log", show=screen.show if name in shown else None, forks=True)
        for name in ("hub", case.viewer, "master", *case.publishers, "dashboard")
    }
    hub, viewer, master, *_ = processes.values()
    deployment = out / "deployment"
    saying = asyncio.create_task(screen.say_what_it_waits_for())
    building = None
    ends: list[asyncio.Future[Any]] = []
    try:
        screen.waits_for = "building the deployment, loading the kernels, which a first start compiles"
        if uri is None:
            screen.show(
                f"starting the hub (the embedded rosbridge server), building the {case.name}'s deployment ..."
            )
            await hub.start("hub", "--port", PORT if count is None else "0")
        else:
            from bridge.discovery import announced_uri

            uri = await announced_uri(uri)  # once, instead of in each process
            screen.show(f"using the rosbridge server at {uri}, building the {case.name}'s deployment ...")
        # the port of this hub, which ends with the demo, is not for the deployment
        source = DEFAULT_URI if uri is None else uri
        building = asyncio.create_task(
            build(case.name, deployment, source, case.topic, case.type, *case.options, boards=case.boards)
        )
        await asyncio.sleep(0)
        # once, for viewer, master and the robot's side, which are forked from this process
        import_module("posteriors")
        uri = (await hub.line(r"ws://\S+"))[0] if uri is None else uri
        counted = () if count is None else ("--count", str(count))
        await viewer.start(
            *(case.viewer, "--uri", uri, *counted, "--out", str(out), *case.viewing),
            *("--first-timeout", str(FIRST_TIMEOUT)),
        )
        # nothing is forked before the kernels are loaded, because a fork would inherit the locks of their thread
        await asyncio.gather(building, viewer.line("listening"), _load_kernels())
        screen.waits_for = "waiting for results"
        await master.start(
            *("master", "--loop", *(counted if case.counts_frames else ())),
            *("-d", str(deployment), "--uri", uri, *options),
        )
        for name, flags in case.publishers.items():
            await processes[name].start(name, "--uri", uri, *flags)
        if page_port is not None:
            await viewer.line(FIRST_RESULT)
            await processes["dashboard"].start(
                *("dashboard", "--uri", uri, "-d", str(deployment), "--page-port", str(page_port))
            )
            address = await processes["dashboard"].line(r"http://\S+")
            saying.cancel()
            screen.show(f"open {address[0]} in a browser{case.pointer}")
        ends = _ends(case, count, master, viewer)
        # the first end counts: a failure need not wait for the other's timeout, and a master without a count never ends
        await next(iter((await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED))[0]))
        if case.counts_frames:
            await ends[0]
        screen.waits_for = "drawing the pictures"
        await ends[1]
        screen.show(
            f"done in {time.monotonic() - started:.1f} s; pictures are in {out}\n"
            "to watch it live in a browser: the same command with --dashboard"
        )
    finally:
        saying.cancel()
        if building is not None:
            building.cancel()
        await asyncio.gather(*(process.end() for process in reversed(processes.values())))
        await asyncio.gather(*ends, return_exceptions=True)
    return 0
