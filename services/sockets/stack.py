"""The processes of a run, found by their status sockets and queried in parallel."""

import asyncio
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec

from services.errors import SettingsError
from services.sockets.status import ProcessStatus, read_process_status
from services.supervision.private_directory import DIRECTORY_PREFIX
from terminal.health import SUFFIX, NoHealthError

ANSWER_TIME = 1.0
"""Seconds in which all processes must answer."""
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


def run_directories() -> list[Path]:
    """Return the private directories of the user's runs, alive or dead, sorted by name."""
    places = {Path(tempfile.gettempdir())}
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        places.add(Path(runtime))
    return sorted(
        path for place in places for path in place.glob(f"{DIRECTORY_PREFIX}*") if _is_own_directory(path)
    )


def _is_own_directory(path: Path) -> bool:
    """Return whether a directory belongs to this user, even if it disappears or is inaccessible."""
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


def _sort_key(name: str) -> tuple[int, int, str]:
    """Return the sort key of a process: services in the order of a frame's path, then boards by number."""
    if name in _ORDER:
        return _ORDER.index(name), 0, name
    digits = name.removeprefix("board")
    return len(_ORDER), int(digits) if digits.isascii() and digits.isdigit() else 1 << 30, name


async def ask_stack(directory: Path) -> StackStatus:
    """Return the status of the processes in a run directory, queried in parallel, within about a second."""
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
    processes.sort(key=lambda each: _sort_key(each.name))
    silent.sort(key=lambda each: _sort_key(each.name))
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
    """Return the private directory of the user's only living run, or raise a SettingsError."""
    found = run_directories()
    stacks = [await ask_stack(path) for path in found]
    alive = [path for path, stack in zip(found, stacks, strict=True) if stack.processes]
    dead = [str(path) for path in found if path not in alive]
    remark = f" (left behind by runs that were killed: {', '.join(dead)})" if dead else ""
    if not alive:
        raise SettingsError(
            f"no run of this user was found{remark}; start a master, or name the folder of the status sockets with --directory"
        )
    if len(alive) > 1:
        raise SettingsError(
            f"{len(alive)} runs of this user are alive: {', '.join(map(str, alive))}; choose one with --directory{remark}"
        )
    return alive[0]
