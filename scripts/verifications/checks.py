"""Verdicts, counts and servers, common to the verifications."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from scripts.running.flags import ScriptParser
from scripts.running.processes import Process, run_script
from scripts.verifications import real_rosbridge

SERVER_LIMIT = 15.0
"""Seconds until a server must be ready."""


class CheckError(Exception):
    """A check that failed, with the reason."""


class DownloadError(Exception):
    """A download that failed, so that nothing could be checked."""


def expect(condition: bool, otherwise: str) -> None:
    """Raise an error unless a condition holds.

    Raises:
        CheckError: The condition does not hold.
    """
    if not condition:
        raise CheckError(otherwise)


@dataclass(slots=True)
class Tally:
    """Numbers of checks that passed and failed."""

    passed: int = 0
    failed: int = 0

    def report(self, name: str, started: float, why: str | None, details: str = "") -> None:
        """Print one check's line, and details below it."""
        if why is None:
            self.passed += 1
            print(f"ok  {name} ({time.monotonic() - started:.1f} s)")
        else:
            self.failed += 1
            print(f"FAIL {name}: {why}")
        if details:
            print(details)
        sys.stdout.flush()


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of server: its command, its ready line, and whether messages of two topics keep their order."""

    name: str
    command: tuple[str, ...]
    ready: str
    keeps_order: bool


KINDS = {
    "real": Kind(
        "real ROS 2 server",
        ("python", real_rosbridge.__file__, "serve", "PORT"),
        ready=real_rosbridge.READY,
        keeps_order=False,  # DDS transports each topic separately
    ),
    "hub": Kind("hub", ("hub", "--host", "127.0.0.1", "--port", "PORT"), ready=r"ws://\S+", keeps_order=True),
}


async def serving(kind: Kind, port: int, log: Path) -> Process:
    """Start a server on a port of loopback, and wait until it serves.

    Raises:
        CheckError: It is not ready in time.
    """
    server = Process(kind.name, log)
    try:
        await server.start(*(word.replace("PORT", str(port)) for word in kind.command))
        async with asyncio.timeout(SERVER_LIMIT):
            await server.line(kind.ready)
    except TimeoutError:
        await server.end()
        raise CheckError(f"the {kind.name} did not serve within {SERVER_LIMIT:g} s") from None
    except BaseException:
        await server.end()
        raise
    return server


def on_servers(
    name: str, description: str, verify: Callable[[list[str]], Awaitable[int]], limit: float
) -> int:
    """Parse the flags of a verification and run it, with the real server in a separate network.

    Args:
        name: Name of the verification and of its module.
        description: Docstring of the module, whose first line is shown by `--help`.
        verify: Function that runs all checks on these kinds of servers, `real` or `hub`, and returns the exit
            code.
        limit: Time limit in seconds.
    """
    parser = ScriptParser(prog=f"scripts/verify {name}", description=description.splitlines()[0])
    parser.add_argument("--server", choices=["real", "hub", "both"], default="both", help="the servers")
    server = parser.parse_args().server
    kinds = ["real", "hub"] if server == "both" else [server]
    if "real" in kinds and not real_rosbridge.network_is_alone():
        try:
            real_rosbridge.install()
            alone = real_rosbridge.network_command()
            real_rosbridge.become(
                [*alone, sys.executable, "-P", "-m", f"{__package__}.{name}", "--server", server]
            )
        except real_rosbridge.RealServerError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("interrupted (Ctrl-C)", file=sys.stderr)
            return 130
    return run_script(lambda: verify(kinds), limit)
