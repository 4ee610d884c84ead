"""The processes of a run, found by their status sockets and queried in parallel."""

import asyncio
import os
import tempfile
from collections.abc import Iterable
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import msgspec

from services.errors import SettingsError
from services.sockets.status import ProcessStatus, read_process_status
from terminal.health import SUFFIX, NoHealthError
from terminal.one_line import shown
from terminal.private_directory import DIRECTORY_PREFIX

ANSWER_TIME = 1.0
"""Seconds in which all processes must answer."""
_AT_ONCE = 256
"""Maximum number of processes asked at the same time."""
_ORDER = ("hub", "master", "subscriber", "publisher", "pcie-app")


class SilentProcess(msgspec.Struct, frozen=True):
    """A process with a status socket, or a peer of the master, that did not answer."""

    name: str
    why: str


class StackStatus(msgspec.Struct, frozen=True, kw_only=True):
    """All processes of a run; `why` contains a sentence for each one that is not ready."""

    directory: str
    ready: bool
    why: list[str]
    processes: list[ProcessStatus]
    silent: list[SilentProcess]


class Found(NamedTuple):
    """The private directory of a run, if any, and those of processes that belong to no run, such as a hub."""

    run: Path | None
    others: list[Path]


def run_directories() -> list[Path]:
    """Return the private directories of this user's processes, alive or dead, sorted by name."""
    places = {Path(tempfile.gettempdir())}
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        places.add(Path(runtime))
    return sorted(
        path for place in places for path in place.glob(f"{DIRECTORY_PREFIX}*") if _is_own_directory(path)
    )


def _is_own_directory(path: Path) -> bool:
    """Return whether a directory belongs to this user, even if it disappears; a link may be of another user."""
    try:
        return path.is_dir() and not path.is_symlink() and path.stat().st_uid == os.getuid()
    except OSError:
        return False


def _status_sockets(directory: Path) -> list[Path]:
    return list(directory.glob(f"*{SUFFIX}"))


async def _ask(path: Path, turns: asyncio.Semaphore) -> ProcessStatus | SilentProcess:
    name = path.name.removesuffix(SUFFIX)
    try:
        async with turns:
            return msgspec.structs.replace(await read_process_status(str(path), ANSWER_TIME), name=name)
    except NoHealthError as error:
        return SilentProcess(name, f"it {error}")


def _sort_key(name: str) -> tuple[int, int, str]:
    """Return the sort key of a process: services in the order of a frame's path, then boards by number."""
    if name in _ORDER:
        return _ORDER.index(name), 0, name
    digits = name.removeprefix("board")
    return len(_ORDER), int(digits) if digits.isascii() and digits.isdigit() else 1 << 30, name


async def ask_stack(directory: Path | None, others: Iterable[Path] = ()) -> StackStatus:
    """Return the status of the processes in a run directory, queried in parallel.

    Up to 256 processes take at most about a second.

    Of the `others`, only those that answer are included.
    """
    paths = _status_sockets(directory) if directory is not None else []
    more = [path for other in others for path in _status_sockets(other)]
    turns = asyncio.Semaphore(_AT_ONCE)
    asked = await asyncio.gather(*(_ask(path, turns) for path in [*paths, *more]))
    answers = asked[: len(paths)] + [each for each in asked[len(paths) :] if isinstance(each, ProcessStatus)]
    processes = [each for each in answers if isinstance(each, ProcessStatus)]
    silent = [each for each in answers if isinstance(each, SilentProcess)]
    answered = {each.name for each in answers}
    silent.extend(
        SilentProcess(peer.name, f"the master waits for it at {peer.endpoint}")
        for process in processes
        for peer in process.peers
        if peer.name not in answered and not peer.ready
    )
    processes.sort(key=lambda each: _sort_key(each.name))
    silent.sort(key=lambda each: _sort_key(each.name))
    why = [f"{each.name}: {each.why}" for each in processes if not each.ready]
    why += [f"{each.name}: {each.why}" for each in silent]
    return StackStatus(
        directory=str(directory) if directory is not None else "no run",
        ready=bool(processes) and not why,
        why=why,
        processes=processes,
        silent=silent,
    )


async def find_run(name: str | None = None) -> Found:
    """Return the user's only living run, or the one with this name, and the processes without a run.

    Raises:
        SettingsError: There is no such run, or there are several, or no process at all.
    """
    found = run_directories()
    stacks = dict(zip(found, await asyncio.gather(*(ask_stack(path) for path in found)), strict=True))
    alive = {path: stack for path, stack in stacks.items() if stack.processes}
    runs = [path for path in alive if (path / f"master{SUFFIX}").exists()]
    others = [path for path in alive if path not in runs]
    dead = [str(path) for path in found if path not in alive]
    remark = f" (left behind by runs that were killed: {', '.join(dead)})" if dead else ""
    known = "; ".join(f"{run_name(path)} ({_described(alive[path])})" for path in runs)
    if name is not None:
        chosen = [path for path in runs if run_name(path) == name]
        if not chosen:
            raise SettingsError(
                f"--run {shown(name)} is not a living run of this user: {known or 'there is none'}{remark}"
            )
        return Found(chosen[0], others)
    if len(runs) > 1:
        raise SettingsError(f"{len(runs)} runs of this user are alive: {known}; choose one with --run NAME")
    if runs:
        return Found(runs[0], others)
    if others:
        return Found(None, others)
    raise no_run_error(remark)


def no_run_error(remark: str = "") -> SettingsError:
    """Return the error that there is no run."""
    return SettingsError(
        f"no run of this user was found{remark}; start a master, or name the folder of the status sockets with --directory"
    )


def run_name(directory: Path) -> str:
    """Return the name of a run: the end of its private directory's name."""
    return directory.name.removeprefix(DIRECTORY_PREFIX)


def _described(stack: StackStatus) -> str:
    """Return the start and the deployment of a run."""
    for process in stack.processes:
        if process.name == "master":
            started = datetime.now().astimezone() - timedelta(seconds=process.uptime_s)
            return f"since {started:%Y-%m-%d %H:%M:%S}, {shown(process.folder)}"
    return "its master does not answer"
