"""The whole stack in one screen: asks every process of a run at its status socket, all at once."""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from services.command_line import ends_well, make_app, run_async
from services.errors import ExitCode, SettingsError
from services.settings import load_settings
from services.sockets.status_socket import STATUS_LIMIT, SUFFIX, BoardStatus, FrameCounts, ProcessStatus
from services.supervision import PRIVATE

if TYPE_CHECKING:
    from rich.console import RenderableType

ANSWER_TIME = 1.0
"""Seconds that all processes together have to answer."""

WATCH_EVERY = 1.0
_SHOWN = 200
"""Characters of a sentence or name that are shown: what answers may be anything."""

_PLAIN_WIDTH = 140
_ORDER = ("hub", "master", "subscriber", "publisher", "pcie-app")


class SilentProcess(msgspec.Struct, frozen=True):
    """A process that has a status socket, or that the master works with, but did not answer."""

    name: str
    why: str


class StackStatus(msgspec.Struct, frozen=True, kw_only=True):
    """All processes of one run; `why` has a sentence for each that is not ready."""

    directory: str
    ready: bool
    why: list[str]
    processes: list[ProcessStatus]
    silent: list[SilentProcess]


class _SilentError(Exception):
    """A process did not answer; the text says why."""


def run_directories() -> list[Path]:
    """The private directories of this user's runs, whether those still run or not, by name."""
    places = {Path(tempfile.gettempdir())}
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        places.add(Path(runtime))
    return sorted(path for place in places for path in place.glob(f"{PRIVATE}*") if _is_own_directory(path))


def _is_own_directory(path: Path) -> bool:
    """Whether it is a directory of this user; a run may end meanwhile, and others' may be closed to us."""
    try:
        return path.is_dir() and path.stat().st_uid == os.getuid()
    except OSError:
        return False


def _status_sockets(directory: Path) -> list[Path]:
    return list(directory.glob(f"*{SUFFIX}"))


async def _answer(path: Path) -> ProcessStatus:
    try:
        reader, writer = await asyncio.open_unix_connection(path)
        try:
            data = bytearray()
            while part := await reader.read(65536):
                data += part
                if len(data) > STATUS_LIMIT:
                    msg = f"what answers at {path} says more than {STATUS_LIMIT} bytes: it is no process of rosbayes"
                    raise _SilentError(msg)
        finally:
            writer.close()
    except ConnectionRefusedError as error:
        msg = f"nobody listens at {path}: it was killed, and has not been started again yet"
        raise _SilentError(msg) from error
    except OSError as error:
        msg = f"it can't be asked at {path} ({error.strerror or error})"
        raise _SilentError(msg) from error
    try:
        return msgspec.json.decode(data, type=ProcessStatus)
    except (msgspec.MsgspecError, RecursionError) as error:
        msg = f"what answers at {path} is no process of rosbayes, or one of another version ({error})"
        raise _SilentError(msg) from error


async def _ask(path: Path) -> ProcessStatus | SilentProcess:
    name = path.name.removesuffix(SUFFIX)
    try:
        async with asyncio.timeout(ANSWER_TIME):
            return msgspec.structs.replace(await _answer(path), name=name)
    except _SilentError as silent:
        return SilentProcess(name, str(silent))
    except TimeoutError:
        return SilentProcess(name, f"it does not answer at {path} within {ANSWER_TIME:g} s: it is stuck")


def _place(name: str) -> tuple[int, int, str]:
    """Where a process stands in a list: the known ones in the order of a frame's way, boards by number."""
    if name in _ORDER:
        return _ORDER.index(name), 0, name
    digits = name.removeprefix("board")
    return len(_ORDER), int(digits) if digits.isascii() and digits.isdigit() else 1 << 30, name


async def ask_stack(directory: Path) -> StackStatus:
    """What the processes in a run directory say of themselves, asked in parallel, within about a second."""
    answers = await asyncio.gather(*(_ask(path) for path in _status_sockets(directory)))
    processes = [each for each in answers if isinstance(each, ProcessStatus)]
    silent = [each for each in answers if isinstance(each, SilentProcess)]
    heard = {each.name for each in answers}
    silent.extend(
        SilentProcess(peer.name, f"the master waits for it at {peer.endpoint}")
        for process in processes
        for peer in process.peers
        if peer.name not in heard and not peer.ready
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


# --- what the user sees ------------------------------------------------------------------------


def _plain(text: str) -> str:
    """A text that can't write over the terminal."""
    kept = "".join(each if each.isprintable() else "?" for each in text[:_SHOWN])
    return kept if len(text) <= _SHOWN else f"{kept}..."


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


def _counts(frames: FrameCounts | None) -> tuple[str, str, str, str, str]:
    if frames is None:
        return "", "", "", "", ""
    number = "" if frames.last_number is None else f"{frames.last_number}, "
    last = "none yet" if frames.last_age_s is None else f"{number}{_duration(frames.last_age_s)} ago"
    lost = ", ".join(f"{count} {_plain(reason)}" for reason, count in frames.lost.items())
    return str(frames.received), str(frames.completed), f"{frames.rate:.1f}", last, lost or "none"


def _boards(stack: StackStatus) -> list[BoardStatus]:
    """The boards by number: as pcie-app sees them, with the restarts that they know themselves."""
    boards: dict[int, BoardStatus] = {}
    for process in stack.processes:
        for board in process.boards:
            known = boards.get(board.index)
            if known is None:
                boards[board.index] = board
                continue
            seen, own = (known, board) if known.image else (board, known)
            restarts = max(seen.restarts, own.restarts)
            boards[board.index] = msgspec.structs.replace(seen, restarts=restarts)
    return [boards[index] for index in sorted(boards)]


def screen(stack: StackStatus) -> RenderableType:
    """One screen: the verdict, the processes, their connections, the boards."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    restarts = {peer.name: peer.restarts for process in stack.processes for peer in process.peers}
    parts: list[RenderableType] = []
    if stack.ready:
        parts.append(Text(f"{stack.directory}: all {len(stack.processes)} processes are ready", "green"))
    else:
        parts.append(Text(f"{stack.directory}: not ready", "bold red"))
        parts.extend(Text(f"  {_plain(sentence)}", "red") for sentence in stack.why)

    parts.extend(
        Text(
            f"deployment {_plain(process.deployment[:12])} of {_plain(process.folder)}, generation {process.generation}"
        )
        for process in stack.processes
        if process.folder
    )

    table = Table(box=None, pad_edge=False)
    table.add_column("process")
    table.add_column("ready")
    for heading in ("pid", "up", "restarts", "received", "completed", "per s"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("last frame", no_wrap=True)
    table.add_column("lost")
    for process in stack.processes:
        table.add_row(
            Text(_plain(process.name)),
            Text("yes", "green") if process.ready else Text("no", "red"),
            str(process.pid),
            _duration(process.uptime_s),
            str(restarts.get(process.name, sum(board.restarts for board in process.boards[:1])))
            if process.name in restarts or process.name.startswith("board")
            else "",
            *map(Text, _counts(process.frames)),
        )
    for silent in stack.silent:
        table.add_row(Text(_plain(silent.name)), Text("no answer", "red"))
    parts.append(table)

    connections = [(process.name, each) for process in stack.processes for each in process.connections]
    if connections:
        table = Table(box=None, pad_edge=False)
        for heading in ("rosbridge of", "server", "state", "reconnections"):
            table.add_column(heading)
        for name, connection in connections:
            table.add_row(
                Text(_plain(name)),
                Text(_plain(connection.uri)),
                Text(_plain(connection.state), "green" if connection.state == "connected" else "red"),
                str(connection.reconnections),
            )
        parts.extend([Text(""), table])

    parts.extend(
        Text(f"\n{_plain(process.name)}: {hub.clients} clients, {hub.topics} topics, {hub.services} services")
        for process in stack.processes
        if (hub := process.hub) is not None
    )

    boards = _boards(stack)
    if boards:
        table = Table(box=None, pad_edge=False)
        for heading in ("board", "state", "image", "restarts", "last cycles", "endpoint"):
            table.add_column(heading)
        for board in boards:
            table.add_row(
                str(board.index),
                Text(_plain(board.state), "green" if board.state in {"programmed", "blank"} else "red"),
                Text(_plain(board.image[:12])),
                str(board.restarts),
                "" if board.last_cycles is None else str(board.last_cycles),
                Text(_plain(board.endpoint)),
            )
        parts.extend([Text(""), table])
    return Group(*parts)


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
    names = ", ".join(_plain(each.name) for each in stack.silent)
    killed = f" (sockets of killed processes: {names})" if names else ""
    msg = f"no process of rosbayes answers in {directory}{killed}; is the stack started, with this BM_RUN_DIRECTORY?"
    raise SettingsError(msg)


app = make_app(
    "Show the whole stack in one screen: processes, boards and images, last frame, rates, losses by reason.\n\n"
    "`status` finds the one run of this user; `status --directory DIR` asks the processes with that BM_RUN_DIRECTORY.\n\n"
    "Exit codes: 0 all is ready, 6 something is not, 2 nothing was found."
)


@app.command(help=app.info.help)
@ends_well
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
        msg = (
            f"{named} is no folder; name the one with the status sockets (BM_RUN_DIRECTORY of the processes)"
        )
        raise SettingsError(msg)

    async def run() -> int:
        return await show(named or await find_run(), watch=watch, json=json)

    return run_async(run())


def main() -> None:
    """Entry point of the command `status`."""
    app()


if __name__ == "__main__":
    main()
