"""Boards that misbehave: `python -m tests.misbehaving_board ENDPOINT INDEX KIND[:AFTER[:TIMES]]` serves one.

The board misbehaves after AFTER successful starts and resumes (0: from the opening on), for TIMES answers (0: forever).
"""

import re
import select
import signal
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum

from pcie_shim import framing
from pcie_shim import register_map as rm
from pcie_shim.board.connection import HostConnection
from pcie_shim.board.emulated_board import EmulatedBoard
from pcie_shim.board.server import BoardServer, StopSignal
from pcie_shim.endpoint import Endpoint, parse_endpoint
from pcie_shim.framing import Frame
from pcie_shim.register_layout import ALL_ONES, DONE_BLOCK
from pcie_shim.register_map import BoardState


class Kind(StrEnum):
    """The kind of fault; an answer is that to a request, or an interrupt."""

    DROP = "drop"  # an answer is not sent
    STALL = "stall"  # the board stops serving its host, but keeps the link open
    SHORT_READ = "short-read"  # an answer lacks one word
    ENDLESS = "endless"  # an answer begins and does not end
    WRONG_SEQUENCE = "wrong-sequence"  # an answer has another sequence number
    WRONG_CRC = "wrong-crc"  # an answer has a wrong CRC
    ALL_ONES = "all-ones"  # every register reads all ones, as if the device were gone
    WRONG_MAP = "wrong-map"  # the greeting contains another register map
    NEVER_DONE = "never-done"  # the machine starts and never stops
    DONE_TWICE = "done-twice"  # an interrupt is sent twice, with the same doorbell number
    DONE_EARLY = "done-early"  # an interrupt is sent before the machine has run
    STALE_RESULT = "stale-result"  # an interrupt has the doorbell number and results of the previous one
    NO_RESULTS = "no-results"  # an interrupt lacks the results that the board says it sends
    MORE_RESULTS = "more-results"  # an interrupt has results that the board does not say it sends
    RESET_AFTER_DONE = (
        "reset-after-done"  # the board is reset between an interrupt and the reading of the results
    )


@dataclass(slots=True)
class Fault:
    """A kind of fault, the time of its first occurrence, and how often it has occurred."""

    kind: Kind
    after: int = 0
    times: int = 0
    occurred: int = 0

    @classmethod
    def parse(cls, text):
        match = re.fullmatch(r"([a-z-]+)(?::(\d+))?(?::(\d+))?", text)
        assert match is not None, text
        return cls(Kind(match[1]), int(match[2] or 0), int(match[3] or 0))

    def occurs(self, kind: Kind, starts: int) -> bool:
        """Return whether this kind of fault occurs now, after so many starts, and count it."""
        if self.kind is not kind or 0 < self.after >= starts or 0 < self.times <= self.occurred:
            return False
        self.occurred += 1
        return True


class MisbehavingBoard(EmulatedBoard):
    """A board that counts its starts, and may run forever without a cycle."""

    def __init__(self, fault: Fault, *, sends_results: bool) -> None:
        super().__init__(sends_results=sends_results)
        self.fault = fault
        self.starts = 0
        self.stuck = False

    def write(self, address: int, words: bytes | memoryview) -> None:
        done = self.done
        if not self.running:
            self.stuck = rings(address, len(words)) and self.fault.occurs(Kind.NEVER_DONE, self.starts + 1)
        super().write(address, words)
        self.starts += self.done != done or self.running

    def step(self) -> None:
        if self.stuck:
            time.sleep(0.01)
        super().step()

    def _run(self, *chunk) -> None:
        if not self.stuck:
            super()._run(*chunk)
            return
        self.running = True
        self._publish(BoardState.RUNNING, 0, 0)


class MisbehavingServer(BoardServer):
    """A server that sends what no board should send."""

    board: MisbehavingBoard

    def __init__(
        self, endpoint: Endpoint, index: int, stop: StopSignal, fault: Fault, *, sends_results: bool
    ) -> None:
        super().__init__(endpoint, index, stop, MisbehavingBoard(fault, sends_results=sends_results))
        self._fault = fault
        self._last_results = b""
        self._stalled: set[HostConnection] = set()

    def _now(self, kind: Kind, *, ahead: int = 0) -> bool:
        return self._fault.occurs(kind, self.board.starts + ahead)

    def _greeting(self, token: bytes) -> bytes:
        payload = super()._greeting(token)[framing.HEADER_BYTES :]
        if self._now(Kind.WRONG_MAP):
            payload = payload.replace(bytes.fromhex(rm.MAP_SHA256), bytes(32))
        return framing.encode(framing.GREET, 0, 0, 0, len(payload) // 4, payload)

    def _serve_host(self, host: HostConnection) -> None:
        if host not in self._stalled:
            super()._serve_host(host)
        elif not self._drop_if_closed(host):
            time.sleep(0.01)

    def _is_held(self) -> bool:
        if self._host in self._stalled:
            self._drop_if_closed(self._host)
        return super()._is_held() if self._host not in self._stalled else True

    def _drop_if_closed(self, host: HostConnection) -> bool:
        """Drop a host that has disconnected, without reading from it."""
        poll = select.poll()
        poll.register(host.socket, select.POLLRDHUP)
        if closed := bool(poll.poll(0)):
            self._stalled.discard(host)
            self._drop_host(host)
        return closed

    def _access(self, host: HostConnection, frame: Frame) -> None:
        if host in self._stalled:
            return
        is_start = frame.operation == framing.WRITE and rings(frame.address, len(frame.payload))
        if is_start and not self.board.running and self._now(Kind.DONE_EARLY, ahead=1):
            self._interrupt(host)
        super()._access(host, frame)

    def _send(self, host, operation, flags, sequence, address, words):
        if host in self._stalled or self._now(Kind.DROP):
            return
        if self._now(Kind.STALL):
            self._stalled.add(host)
            return
        if operation == framing.IRQ:
            last, self._last_results = self._last_results, words
            words = last if last and self._now(Kind.STALE_RESULT) else words
            if self._now(Kind.NO_RESULTS):
                words = words[: DONE_BLOCK.size]
            if self._now(Kind.MORE_RESULTS):
                words += bytes(4)
            if self._now(Kind.RESET_AFTER_DONE):
                self.board.reset()
        if words and self._now(Kind.SHORT_READ):
            words = words[:-4]
        if words and self._now(Kind.ALL_ONES):
            words = b"\xff" * len(words)
        if self._now(Kind.WRONG_SEQUENCE):
            sequence = (sequence + 1) & ALL_ONES
        data = framing.encode(operation, flags, sequence, address, len(words) // 4, words)
        if operation == framing.IRQ and self._now(Kind.DONE_TWICE):
            host.interrupts = (host.interrupts + 1) & ALL_ONES
            data += framing.encode(operation, flags, host.interrupts, address, len(words) // 4, words)
        if self._now(Kind.WRONG_CRC):
            data = data[:16] + bytes(byte ^ 0xFF for byte in data[16:20]) + data[20:]
        if self._now(Kind.ENDLESS):
            data = data[:-2]
            self._stalled.add(host)
        host.send(data)


def rings(address: int, octets: int) -> bool:
    """Return whether a write covers a doorbell."""
    return address <= rm.RESUME and address + octets > rm.START


def serve_misbehaving(endpoint, *, index, stop, fault, on_ready, sends_results=True):
    """Serve a board with this fault until `stop` is set."""
    where = parse_endpoint(endpoint) if isinstance(endpoint, str) else endpoint
    fault = Fault.parse(fault)
    with closing(MisbehavingServer(where, index, stop, fault, sends_results=sends_results)) as server:
        on_ready(server.board)
        server.run()


def main(endpoint, index, fault):
    stop = StopSignal()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    serve_misbehaving(
        endpoint,
        index=int(index),
        stop=stop,
        fault=fault,
        on_ready=lambda _: print(f"board {index} listens at {endpoint}", file=sys.stderr, flush=True),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
