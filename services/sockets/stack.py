"""The processes of a run, found by the status sockets in its directory and queried in parallel."""

import asyncio
from pathlib import Path

import msgspec

from services.sockets.status import ProcessStatus, read_process_status
from terminal.health import SUFFIX, NoHealthError

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


async def ask_stack(directory: Path) -> StackStatus:
    """Return the status of the processes in a run directory, queried in parallel.

    Up to 256 processes take at most about a second.
    """
    turns = asyncio.Semaphore(_AT_ONCE)
    answers = await asyncio.gather(*(_ask(path, turns) for path in _status_sockets(directory)))
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
