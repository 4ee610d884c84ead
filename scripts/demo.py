"""The demo's processes, started in order and ended together: see scripts/demo."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import re
import signal
import sys
import time
from pathlib import Path

from services.command_line import run_async
from services.errors import ExitCode, ServiceError, StoppedError
from services.supervision import own_command

ROOT = Path(__file__).resolve().parent.parent
TOPIC, TYPE = "/boat/sensors", "boat_msgs/Sensors"
LIMIT = 180.0
"""Seconds after which the demo gives up, whatever it waits for."""


class Process:
    """One process of the demo: its lines go to a log, and to the screen if they are meant for it."""

    def __init__(self, name: str, log: Path, *, shown: bool = False) -> None:
        self.name = name
        self._log = log
        self._shown = shown
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._lines: list[str] = []
        self._news = asyncio.Event()

    async def start(self, *command: str) -> None:
        """Start it in a session of its own, so that Ctrl-C reaches the demo alone."""
        self._process = await asyncio.create_subprocess_exec(
            *own_command(command[0]),
            *command[1:],
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )
        self._reader = asyncio.create_task(self._read())

    async def _read(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        with self._log.open("w") as log:
            async for line in self._process.stdout:
                text = line.decode("utf-8", "replace").rstrip()
                log.write(text + "\n")
                log.flush()
                self._lines.append(text)
                self._news.set()
                if self._shown:
                    print(text, flush=True)
        self._news.set()

    async def line(self, pattern: str) -> re.Match[str]:
        """Wait for a line that matches.

        Raises:
            ServiceError: the process ended before it printed one.
        """
        seen = 0
        while True:
            for text in self._lines[seen:]:
                if match := re.search(pattern, text):
                    return match
            seen = len(self._lines)
            if self._reader is not None and self._reader.done():
                raise ServiceError(f"{self.name} ended early: {self.last_line()} (see {self._log})")
            self._news.clear()
            await self._news.wait()

    def last_line(self) -> str:
        """What it said last."""
        return self._lines[-1].removeprefix("error: ") if self._lines else "it said nothing"

    async def wait(self) -> int:
        """Its exit code, once it has ended and all its lines are read."""
        assert self._process is not None
        if self._reader is not None:
            await self._reader
        return await self._process.wait()

    async def end(self) -> None:
        """End it: SIGTERM, and SIGKILL after 6 s."""
        if self._process is None:
            return
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)
            try:
                await asyncio.wait_for(self._process.wait(), 6)
            except TimeoutError:
                self._process.kill()
                await self._process.wait()
        if self._reader is not None:
            await self._reader


async def build(out: Path, uri: str) -> Path:
    """Build the boat's deployment with the toolchain; its report goes to out/toolchain.log."""
    toolchain = Process("toolchain", out / "toolchain.log")
    deployment = out / "deployment"
    await toolchain.start(
        *("toolchain", "build", str(ROOT / "casestudies" / "boat"), "-o", str(deployment)),
        *("--partitions", "4", "--uri", uri, "--topic", TOPIC, "--type", TYPE),
    )
    if code := await toolchain.wait():
        error = ServiceError(toolchain.last_line())
        error.exit_code = code
        raise error
    return deployment


async def demo(arguments: argparse.Namespace) -> int:
    """Build, start everything, wait for the viewer's last picture, end everything."""
    started = time.monotonic()
    out: Path = arguments.out
    processes = {
        name: Process(name, out / f"{name}.log", shown=name in {"boat-viewer", "master"})
        for name in ("hub", "boat-viewer", "master", "boat-normaliser", "boat-simulator")
    }
    hub, viewer, master, normaliser, simulator = processes.values()
    try:
        uri = arguments.uri
        if uri is None:
            print(
                "starting the hub (the embedded rosbridge server) and building the boat's deployment ...",
                flush=True,
            )
            await hub.start("hub", "--port", "0")
            uri = (await hub.line(r"ws://\S+"))[0]
        else:
            print(f"using the rosbridge server at {uri}, and building the boat's deployment ...", flush=True)
        count = str(arguments.count)
        await viewer.start("boat-viewer", "--uri", uri, "--count", count, "--out", str(out))
        building = asyncio.create_task(build(out, uri))
        await viewer.line("listening")
        deployment = await building
        await master.start("master", "--loop", "--count", count, "-d", str(deployment), "--uri", uri)
        await normaliser.start("boat-normaliser", "--uri", uri)
        seed = ["--seed", str(arguments.seed)] if arguments.seed is not None else []
        await simulator.start("boat-simulator", "--uri", uri, "--rate", str(arguments.rate), *seed)
        for name, process in (("master", master), ("boat-viewer", viewer)):
            if code := await process.wait():
                error = ServiceError(f"{name}: {process.last_line()}")
                error.exit_code = code
                raise error
        print(f"done in {time.monotonic() - started:.1f} s; pictures are in {out}", flush=True)
    finally:
        await asyncio.gather(*(process.end() for process in reversed(processes.values())))
    return ExitCode.DONE


async def limited(arguments: argparse.Namespace) -> int:
    """The demo, with an end to its patience."""
    try:
        return await asyncio.wait_for(demo(arguments), LIMIT)
    except TimeoutError:
        msg = f"the demo did not end within {LIMIT:.0f} s; its processes' logs are in {arguments.out}"
        raise ServiceError(msg) from None


def main() -> int:
    """Read the flags, run the demo; one sentence for an error."""
    parser = argparse.ArgumentParser(prog="scripts/demo", description="The boat case, end to end.")
    parser.add_argument("--uri", help="a rosbridge server, instead of the embedded hub (ws://HOST:PORT)")
    parser.add_argument("--count", type=int, default=25, help="frames (25)")
    parser.add_argument("--rate", type=float, default=10.0, help="readings a second (10)")
    parser.add_argument(
        "--seed", type=int, help="of the boat's way and its sensors' noise (a new one each time)"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder for pictures and logs (out)")
    arguments = parser.parse_args()
    if arguments.count < 1:
        parser.error("--count must be 1 or more")
    try:
        arguments.out = arguments.out.resolve()
        arguments.out.mkdir(parents=True, exist_ok=True)
        return run_async(limited(arguments))
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        return stopped.exit_code
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"error: --out {arguments.out}: {error.strerror or error}", file=sys.stderr)
        return ExitCode.USAGE


if __name__ == "__main__":
    sys.exit(main())
