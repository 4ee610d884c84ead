"""The command `status`, which asks every process of a run at its status socket, all at once."""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from services.errors import SettingsError
from services.output.status_screen import SilentProcess, StackStatus, plain, screen
from services.settings import load_settings
from services.sockets.status import ProcessStatus, read_process_status
from services.supervision.private_directory import DIRECTORY_PREFIX
from terminal.command_line import CommandLine
from terminal.errors import ExitCode
from terminal.health import SUFFIX, NoHealthError
from terminal.signals import run_async

ANSWER_TIME = 1.0
"""Seconds that all processes together have to answer."""

WATCH_EVERY = 1.0
_PLAIN_WIDTH = 140
_ORDER = ("hub", "master", "subscriber", "publisher", "pcie-app")


def run_directories() -> list[Path]:
    """The private directories of this user's runs, whether those still run or not, by name."""
    places = {Path(tempfile.gettempdir())}
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        places.add(Path(runtime))
    return sorted(
        path for place in places for path in place.glob(f"{DIRECTORY_PREFIX}*") if _is_own_directory(path)
    )


def _is_own_directory(path: Path) -> bool:
    """Whether it is a directory of this user; a run may end meanwhile, and others' may be closed to us."""
    try:
        return path.is_dir() and path.stat().st_uid == os.getuid()
    except OSError:
        return False


def _status_sockets(directory: Path) -> list[Path]:
    return list(directory.glob(f"*{SUFFIX}"))


def _ask(path: Path) -> ProcessStatus | SilentProcess:
    name = path.name.removesuffix(SUFFIX)
    try:
        return msgspec.structs.replace(read_process_status(str(path), ANSWER_TIME), name=name)
    except NoHealthError as error:
        return SilentProcess(name, f"it {error}")


def _place(name: str) -> tuple[int, int, str]:
    """Where a process stands in a list: the known ones in the order of a frame's way, boards by number."""
    if name in _ORDER:
        return _ORDER.index(name), 0, name
    digits = name.removeprefix("board")
    return len(_ORDER), int(digits) if digits.isascii() and digits.isdigit() else 1 << 30, name


async def ask_stack(directory: Path) -> StackStatus:
    """Return the status of all processes in a run directory, asked in parallel, within about a second."""
    paths = _status_sockets(directory)
    loop = asyncio.get_running_loop()
    with ThreadPoolExecutor(max(1, len(paths))) as pool:
        answers = await asyncio.gather(*(loop.run_in_executor(pool, _ask, path) for path in paths))
    processes = [each for each in answers if isinstance(each, ProcessStatus)]
    silent = [each for each in answers if isinstance(each, SilentProcess)]
    answered = {each.name for each in answers}
    silent.extend(
        SilentProcess(peer.name, f"the master waits for it at {peer.endpoint}")
        for process in processes
        for peer in process.peers
        if peer.name not in answered and not peer.ready
    )
    processes.sort(key=lambda each: _place(each.name))
    silent.sort(key=lambda each: _place(each.name))
    why = [f"{each.name}: {each.why}" for each in processes if not each.ready]
    why += [f"{each.name}: {each.why}" for each in silent]
    return StackStatus(
        directory=str(directory),
        ready=bool(processes) and not why,
        why=why,
        processes=processes,
        silent=silent,
    )


async def find_run() -> Path:
    """The only run of this user that is alive.

    Raises:
        SettingsError: there is none, or more than one.
    """
    found = run_directories()
    stacks = [await ask_stack(path) for path in found]
    alive = [path for path, stack in zip(found, stacks, strict=True) if stack.processes]
    dead = [str(path) for path in found if path not in alive]
    remark = f" (left behind by runs that were killed: {', '.join(dead)})" if dead else ""
    if not alive:
        msg = f"no run of this user was found{remark}; start a master, or name the folder of the status sockets with --directory"
        raise SettingsError(msg)
    if len(alive) > 1:
        msg = f"{len(alive)} runs of this user are alive: {', '.join(map(str, alive))}; choose one with --directory{remark}"
        raise SettingsError(msg)
    return alive[0]


async def show(directory: Path, *, watch: bool, json: bool) -> int:
    """Print a run's status, once or every second.

    Returns:
        0 when all of it is ready, 6 when something is not.

    Raises:
        SettingsError: nothing answers; with `watch` that is shown, and waited out.
    """
    from rich.console import Console
    from rich.live import Live

    terminal = sys.stdout.isatty()
    console = Console(width=None if terminal else _PLAIN_WIDTH, highlight=False)
    live = Live(console=console, auto_refresh=False, screen=True) if watch and terminal and not json else None

    def put(stack: StackStatus) -> None:
        if json:
            sys.stdout.buffer.write(msgspec.json.encode(stack) + b"\n")
            sys.stdout.buffer.flush()
        elif live is not None:
            live.update(screen(stack), refresh=True)
        else:
            console.print(screen(stack))

    if live is not None:
        live.start()
    try:
        while True:
            stack = await ask_stack(directory)
            if not stack.processes and not watch:
                break
            put(stack)
            if not watch:
                return ExitCode.DONE if stack.ready else ExitCode.CHILD
            await asyncio.sleep(WATCH_EVERY)
    finally:
        if live is not None:
            live.stop()
    names = ", ".join(plain(each.name) for each in stack.silent)
    killed = f" (sockets of killed processes: {names})" if names else ""
    msg = f"no process of rosbayes answers in {directory}{killed}; is the stack started, with this BM_RUN_DIRECTORY?"
    raise SettingsError(msg)


app = CommandLine(
    help="Show the whole stack in one screen: processes, boards and images, last frame, rates, losses by reason.\n\n"
    "`status` finds the one run of this user; `status --directory DIR` asks the processes with that BM_RUN_DIRECTORY.\n\n"
    "Exit codes: 0 all is ready, 6 something is not, 2 nothing was found."
)


@app.command(help=app.info.help)
def status(
    directory: Annotated[
        Path | None,
        typer.Option("--directory", help="Folder with the status sockets (BM_RUN_DIRECTORY).", metavar="DIR"),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Go on, every second, until Ctrl-C.")] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; with --watch one a line.")
    ] = False,
) -> int:
    """Show the whole stack in one screen."""
    settings = load_settings(run_directory=directory)

    named = settings.run_directory
    if named is not None and not named.is_dir():
        msg = f"{named} is not a folder; name the one with the status sockets (BM_RUN_DIRECTORY of the processes)"
        raise SettingsError(msg)

    async def run() -> int:
        return await show(named or await find_run(), watch=watch, json=json)

    return run_async(run())


if __name__ == "__main__":
    app()
