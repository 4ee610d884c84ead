"""A simulation of a board's hardware: a child process that executes requests on the board's AXI4-Lite slave.

Requests and answers are lines of hexadecimal numbers (docs/hardware/simulation.md). Between requests, the hardware's
clock stands still. The child ends when its standard input is closed.
"""

import contextlib
import os
import re
import select
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Final, NamedTuple, NoReturn, Self, cast

from pcie_shim.errors import SimulationError

MOST_WORDS: Final = 256
"""Maximum number of words that one request reads."""
ACCESS_CLOCKS: Final = 8
"""Maximum number of clocks that an access takes after the hardware has filled its memories."""
ANSWER_S: Final = 20.0
"""The timeout of an answer is this many seconds plus ten times the expected duration of the request."""
START_S: Final = 600.0
"""Timeout of the first answer in seconds. Before the first answer, the simulator elaborates the hardware."""

_ANSWER: Final = re.compile(rb"([0-9A-Fa-f]) ([0-9A-Fa-f]{8}) ((?:[0-9A-Fa-f]{8})*)")
_CLOSE_S: Final = 1.0
_LONGEST_ANSWER: Final = 8 * MOST_WORDS + 64
_LAST_OUTPUT: Final = 400  # bytes


class SimulatorAnswer(NamedTuple):
    """The answer to one request."""

    response: int
    """For an access, 0 or the last word's error (SLVERR or DECERR). For a run, 1 if an interrupt ended it, else 0."""
    clocks: int
    """Clocks that the request took."""
    words: bytes
    """The words that were read, little-endian. A refused word is not included."""


class Simulation:
    """A running simulation.

    `speed` is the number of simulated clocks per second while the machine runs, or 0 before a measurement.
    """

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        """Start the child process, or raise a SimulationError. The first answer may take START_S seconds."""
        self.speed = 0.0

        # The beginning of an answer whose end has not arrived.
        self._received = bytearray()
        # What the child writes on standard error, for the sentence of an error; a file, because nobody reads it while
        # the child runs.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the child
        try:
            self._child = subprocess.Popen(
                command,
                cwd=folder,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                start_new_session=True,  # so that a Ctrl-C reaches only the board, which ends the child
            )
        except OSError as error:
            self._errors.close()
            raise SimulationError(
                f"the simulation of the hardware cannot be started: {command[0]}: {error.strerror}"
            ) from None
        # both are pipes
        self._requests = cast("IO[bytes]", self._child.stdin)
        self._answers = cast("IO[bytes]", self._child.stdout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the child. If it does not end within a second, kill it."""
        with contextlib.suppress(OSError):
            self._requests.close()
        try:
            self._child.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._answers.close()
        self._errors.close()

    def power_up(self) -> None:
        """Reset the simulated hardware through its reset pin, as at power-up."""
        self._execute("z", 0, 0, 2, START_S)

    def run(self, clocks: int) -> SimulatorAnswer:
        """Run until an interrupt, but at most for the given number of clocks."""
        return self._execute("c", clocks, 0, clocks)

    def read(self, address: int, count: int) -> SimulatorAnswer:
        """Read up to MOST_WORDS words. The read stops at the first refused word."""
        answer = self._execute("r", address, count, ACCESS_CLOCKS * count)
        if len(answer.words) != 4 * count and not (answer.response and len(answer.words) < 4 * count):
            self._fail("answered a read with another number of words")
        return answer

    def write(self, address: int, word: int) -> bool:
        """Write a word, and return whether the hardware accepts it."""
        return not self._execute("w", address, word, ACCESS_CLOCKS).response

    # ---- requests -------------------------------------------------------------------------------------

    def _execute(
        self, operation: str, first: int, second: int, clocks: int, limit: float = 0.0
    ) -> SimulatorAnswer:
        """Send a request that takes about `clocks` clocks of the hardware, and return its answer."""
        # a busy computer must not look like a simulator that hangs
        limit = limit or ANSWER_S + (10 * clocks / self.speed if self.speed else 0)
        try:
            self._requests.write(f"{operation} {first:08x} {second:08x}\n".encode())
        except OSError:
            self._ended()
        line = self._next_line(time.monotonic() + limit, limit)
        match = _ANSWER.fullmatch(line)
        if match is None:
            self._fail(f"answered {line[:80]!r}, which is not an answer")
        response, ran, text = match.groups()
        numbers = bytes.fromhex(text.decode())  # each with the highest digit first
        words = b"".join(numbers[at : at + 4][::-1] for at in range(0, len(numbers), 4))
        return SimulatorAnswer(int(response, 16), int(ran, 16), words)

    def _next_line(self, deadline: float, limit: float) -> bytes:
        output = self._answers.fileno()
        while (end := self._received.find(b"\n")) < 0:
            if len(self._received) > _LONGEST_ANSWER:
                self._fail(f"answered {bytes(self._received[:80])!r}, which is not an answer")
            remaining = deadline - time.monotonic()
            if remaining <= 0 or not select.select([output], [], [], remaining)[0]:
                self._fail(f"did not answer within {limit:.0f} s")
            found = os.read(output, 65536)
            if not found:
                self._ended()
            self._received += found
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        return line

    def _ended(self) -> NoReturn:
        """Raise the error for a child that has closed its pipes."""
        try:
            code = self._child.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._fail("closed its output")
        self._fail(f"ended by signal {-code}" if code < 0 else f"ended with exit code {code}")

    def _fail(self, why: str) -> NoReturn:
        """Kill the child, and raise the error."""
        self._child.kill()
        self._child.wait()
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _LAST_OUTPUT))
        said = " ".join(self._errors.read().decode(errors="replace").split())
        raise SimulationError(f"the simulation of the hardware {why}{f': {said}' if said else ''}")
