"""The status of a stack on one screen: readiness, processes, connections and boards."""

import asyncio
import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services.errors import SettingsError
from services.sockets.status import (
    BoardStatus,
    FrameCounts,
    ProcessStatus,
    SilentProcess,
    StackStatus,
    ask_stack,
)
from terminal.errors import ExitCode
from toolchain.errors import counted

_WATCH_INTERVAL = 1.0
_PLAIN_WIDTH = 140
_SHOWN = 200
"""Maximum number of characters shown of a sentence or name, because other processes' texts have no limit."""
_SILENT_SHOWN = 20
"""Maximum number of silent processes shown, because a folder may contain thousands of abandoned sockets."""
_SENTENCES = 3
"""Maximum number of silent processes named in an error."""


def plain(text: str) -> str:
    """Return a text with `?` for control characters, shortened to `_SHOWN` characters."""
    kept = "".join(each if each.isprintable() else "?" for each in text[:_SHOWN])
    return kept if len(text) <= _SHOWN else f"{kept}..."


def screen(stack: StackStatus) -> RenderableType:
    """Return a screen that shows the status of a stack."""
    # a table appears only if it has rows: a hub alone needs two lines
    parts: list[RenderableType] = [*_verdict(stack), _processes(stack)]
    if any(process.connections for process in stack.processes):
        parts += [Text(""), _connections(stack)]
    parts += [
        Text(
            f"\n{plain(process.name)}: {counted(hub.clients, 'client')}, {counted(hub.topics, 'topic')}, "
            f"{counted(hub.services, 'service')}"
        )
        for process in stack.processes
        if (hub := process.hub) is not None
    ]
    parts += [each for process in stack.processes if process.stages for each in (Text(""), _stages(process))]
    if boards := _boards_by_number(stack):
        parts += [Text(""), _boards(boards)]
    return Group(*parts)


def _verdict(stack: StackStatus) -> Iterator[RenderableType]:
    if stack.ready:
        names = [plain(process.name) for process in stack.processes]
        ready = f"{names[0]} is ready" if len(names) == 1 else f"all {len(names)} processes are ready"
        yield Text(f"{stack.directory}: {ready}", "green")
    else:
        yield Text(f"{stack.directory}: not ready", "bold red")
        more = max(0, len(stack.silent) - _SILENT_SHOWN)  # the sentences about them are the last ones
        yield from (Text(f"  {plain(sentence)}", "red") for sentence in stack.why[: len(stack.why) - more])
        if more:
            yield Text(f"  and {more} more", "red")
    for process in stack.processes:
        if process.folder:
            yield Text(f"deployment {plain(process.deployment[:12])} of {plain(process.folder)}")


def _processes(stack: StackStatus) -> Table:
    # a process does not know how often it was restarted: the master does, or the parent of a board
    restarts = {peer.name: peer.restarts for process in stack.processes for peer in process.peers}
    table = _table("process", "ready")
    for heading in ("pid", "up", "restarts", "CPU %", "MB", "received", "completed", "per s"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("last frame", no_wrap=True)
    table.add_column("lost")
    for process in stack.processes:
        known = restarts.get(process.name)
        if known is None and process.name.startswith("board"):
            known = sum(board.restarts for board in process.boards[:1])
        table.add_row(
            Text(plain(process.name)),
            Text("yes", "green") if process.ready else Text("no", "red"),
            str(process.pid),
            _duration(process.uptime_s),
            "" if known is None else str(known),
            # the processes of the boat report no recent CPU time, so theirs is the mean since the start
            f"{process.cpu_percent if process.version else 100 * process.cpu_s / max(process.uptime_s, 1):.1f}",
            f"{process.memory_bytes / 1e6:.0f}" if process.memory_bytes else "",
            *map(Text, _counts(process.frames)),
        )
    for silent in stack.silent[:_SILENT_SHOWN]:
        table.add_row(Text(plain(silent.name)), Text("no answer", "red"))
    if (more := len(stack.silent) - _SILENT_SHOWN) > 0:
        table.add_row(f"{more} more", Text("no answer", "red"))
    return table


def _stages(process: ProcessStatus) -> Table:
    """Return a table of the latencies of a process's published frames: first of the whole frame, then of each stage."""
    table = _table("latency of")
    for heading in ("p50 ms", "p99 ms", "frames"):
        table.add_column(heading, justify="right")
    for stage in sorted(process.stages, key=lambda each: each.stage != "frame"):
        table.add_row(plain(stage.stage), f"{stage.p50_ms:.3f}", f"{stage.p99_ms:.3f}", str(stage.frames))
    return table


def _connections(stack: StackStatus) -> Table:
    table = _table("rosbridge of", "server", "state", "reconnections")
    for process in stack.processes:
        for connection in process.connections:
            table.add_row(
                Text(plain(process.name)),
                Text(plain(connection.uri)),
                Text(plain(connection.state), "green" if connection.state == "connected" else "red"),
                str(connection.reconnections),
            )
    return table


def _boards(boards: list[BoardStatus]) -> Table:
    table = _table("board", "state", "image", "restarts", "last cycles", "endpoint")
    for board in boards:
        table.add_row(
            str(board.index),
            Text(plain(board.state), "green" if board.state in {"programmed", "blank"} else "red"),
            Text(plain(board.image[:12])),
            str(board.restarts),
            "" if board.last_cycles is None else str(board.last_cycles),
            Text(plain(board.endpoint)),
        )
    return table


def _table(*headings: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in headings:
        table.add_column(heading)
    return table


def _boards_by_number(stack: StackStatus) -> list[BoardStatus]:
    """Return the boards as seen by pcie-app, with the restarts that the boards report."""
    boards: dict[int, BoardStatus] = {}
    for process in stack.processes:
        for board in process.boards:
            known = boards.get(board.index)
            if known is None:
                boards[board.index] = board
                continue
            # pcie-app knows image and cycles; each counts the restarts that it has seen
            seen, own = (known, board) if known.image else (board, known)
            restarts = max(seen.restarts, own.restarts)
            boards[board.index] = msgspec.structs.replace(seen, restarts=restarts)
    return [boards[index] for index in sorted(boards)]


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


def _counts(frames: FrameCounts | None) -> tuple[str, str, str, str, str]:
    """Return the texts of the columns received, completed, per second, last frame and lost."""
    if frames is None:
        return "", "", "", "", ""
    # a subscriber knows no numbers, only the age
    number = "" if frames.last_number is None else f"{frames.last_number}, "
    last = "none yet" if frames.last_age_s is None else f"{number}{_duration(frames.last_age_s)} ago"
    counted = [f"{count} {plain(reason)}" for reason, count in frames.lost.items()]
    counted += [f"({count} without {topic})" for topic, count in frames.without.items()]
    return (
        str(frames.received),
        str(frames.completed),
        f"{frames.rate:.1f}",
        last,
        ", ".join(counted) or "none",
    )


async def show(directory: Path, *, needs_master: bool, watch: bool, json: bool) -> int:
    """Print the status of a run once, or every second with `watch`.

    Return 0 if everything is ready, otherwise 6.

    Raises:
        SettingsError: No process answers, or no master answers although `needs_master` is true. With `watch`, this
            error is not raised.
    """
    # in a file or a pipe, lines are not wrapped to the width of a terminal, and nothing is overwritten
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
            # one screen after another, for a log
            console.print(screen(stack))

    with live or contextlib.nullcontext():
        while True:
            # with --watch, a stack that is gone may come back
            stack = await ask_stack(directory, shared=needs_master)
            if not stack.processes and not watch:
                break
            names = [each.name for each in stack.processes] + [each.name for each in stack.silent]
            if needs_master and "master" not in names and not watch:
                # instead of a screen, which would say that all is ready
                others = ", ".join(map(plain, names[:_SENTENCES])) + (", ..." if names[_SENTENCES:] else "")
                raise SettingsError(
                    f"no master runs in {directory}, only {others}; start one, or name its --run-directory"
                )
            put(stack)
            if not watch:
                return ExitCode.DONE if stack.ready else ExitCode.CHILD
            await asyncio.sleep(_WATCH_INTERVAL)
    raise SettingsError(
        f"no rosbayes process answers in {directory}{_silence(stack.silent)}; "
        "is the stack running, with this --run-directory?"
    )


def _silence(silent: Sequence[SilentProcess]) -> str:
    """Return the reasons of the first silent processes in parentheses, and the number of the others."""
    reasons = [f"{plain(each.name)}: {plain(each.why)}" for each in silent[:_SENTENCES]]
    if more := len(silent) - len(reasons):
        reasons.append(f"and {more} more")
    return f" ({'; '.join(reasons)})" if reasons else ""
