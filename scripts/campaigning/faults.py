"""Faults of a campaign: kinds of faults, the losses that each explains, and seeded schedules."""

import random
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from scripts.campaigning.accounts import (
    FAILED,
    MOST_IN_TRANSIT,
    PASSED_OVER,
    ROSBRIDGE_AWAY,
    WITH_APP,
    WITH_PUBLISHER,
    Excuses,
)
from scripts.campaigning.stack import BOARD_NAMES, BOARDS_PARENT, SERVICES, Topology


class Kind(StrEnum):
    """A kind of fault, named as in `--only`."""

    SIGNALS = "signals"
    ROSBRIDGE = "rosbridge"
    LINKS = "links"
    BOARDS = "boards"
    RESOURCES = "resources"
    CLOCK = "clock"
    INPUT = "input"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: its kind, action (`what`), target and duration (`seconds`).

    The meaning of `number` depends on the action.
    """

    kind: Kind
    what: str
    target: str = ""
    seconds: float = 0.0
    number: int = 0

    def __str__(self) -> str:
        if self.what == "misbehave":
            return f"{self.target} misbehaves: {MISBEHAVIOURS[self.number]}"
        parts = [self.what, self.target, f"{self.seconds:.2f} s" if self.seconds else ""]
        return " ".join(part for part in (*parts, str(self.number or "")) if part)


Step = tuple[Fault, ...]
"""Faults that begin at the same time."""
MISBEHAVIOURS = (
    *("drop", "stall", "short-read", "endless", "wrong-sequence"),
    *("wrong-crc", "all-ones", "never-done", "done-twice", "done-early", "stale-result"),
)

SHORT: tuple[Step, ...] = (
    (Fault(Kind.SIGNALS, "kill", "pcie-app"),),
    (Fault(Kind.LINKS, "cut", "board0"),),
    (Fault(Kind.SIGNALS, "stop", "publisher", 0.5),),
    (Fault(Kind.BOARDS, "misbehave", "board1", number=MISBEHAVIOURS.index("wrong-crc")),),
    (Fault(Kind.ROSBRIDGE, "gone", "rosbridge", 0.5),),
    (Fault(Kind.SIGNALS, "kill", "subscriber"),),
    (Fault(Kind.LINKS, "cut-inside", "publisher", 0.3),),
    (Fault(Kind.SIGNALS, "kill", "hub"),),
)
"""The steps of `--short`, for a stack whose parts the campaign starts."""

# --- what a fault explains -------------------------------------------------------------------

ENDS = {"master": 1, "hub": 2, "boards": 3}
"""Maximum number of ends of a role by faults in a round; a board's 4th failure in a minute would end the master."""
MOST_ENDS = 2
"""Maximum ends per round of each role that is not in `ENDS`, and of each role's connection to the master."""
_ENDS_LINK = {"kill", "corrupt", "repeat", "cut", "finish", "cut-inside", "memory"}
_FAILS_BOARD = {*_ENDS_LINK, "stop", "hold"}
_CUTS_ROSBRIDGE = {"gone", "finish", "nonsense", "cut-inside", "files"}
_SILENCE = 9.0
"""Seconds of silence above which a server may lose its clients. A client gives up a silent connection after 10 s."""
_REASONS = {
    "pcie-app": {WITH_APP},
    "publisher": {WITH_PUBLISHER, ROSBRIDGE_AWAY},
    "master": {PASSED_OVER, ROSBRIDGE_AWAY},
    "hub": {ROSBRIDGE_AWAY},
}
"""Reasons under which readings are lost, by the service that is ended."""


def ended_roles(fault: Fault) -> tuple[str, ...]:
    """Return the roles that a fault ends, with one entry per end (see `ENDS`).

    A frame that fails on a board counts as an end of the board.
    """
    if fault.what == "misbehave":
        return ("boards", "boards")  # it has been killed before
    if fault.target == BOARDS_PARENT and fault.what == "kill":
        return ("boards",)
    if fault.target in BOARD_NAMES and fault.what in _FAILS_BOARD:
        return ("boards",)
    return (fault.target,) if fault.what in _ENDS_LINK and fault.target != "rosbridge" else ()


def _reasons(fault: Fault, topology: Topology) -> set[str]:
    """Return the reasons under which a fault may lose readings or results."""
    if fault.target in {*BOARD_NAMES, BOARDS_PARENT}:
        return {FAILED}
    reasons: set[str] = set()
    if fault.target in {"rosbridge", "hub"} or fault.what == "files":
        reasons |= {ROSBRIDGE_AWAY}
    if fault.what in _ENDS_LINK:
        reasons |= _REASONS.get(fault.target, set())
    has_boards = fault.target == "pcie-app" or (fault.target == "master" and topology.fused)
    if has_boards and fault.what in {"stop", "memory"}:
        reasons |= {FAILED}  # the boards' deadlines pass while it does not run
    return reasons


def excuses_of(step: Step, topology: Topology, until: float = 0.0) -> Excuses:
    """Return the losses that a step explains: those that the stack counts, and readings and results in transit."""
    reasons: set[str] = set()
    readings = results = False
    for fault in step:
        reasons |= _reasons(fault, topology)
        given_up = fault.what == "hold" and fault.seconds > _SILENCE
        cut = fault.target == "rosbridge" and (fault.what in _CUTS_ROSBRIDGE or given_up)
        ended = fault.target if fault.what in _ENDS_LINK else ""
        both = cut or fault.what == "files"
        readings |= both or ended in {"hub", "master", "subscriber"}
        results |= both or ended in {"hub", "master", "publisher"}
    # after nonsense, a client may take its time to close a connection from which it does not read any more
    held = any(fault.what in {"stop", "hold", "slow", "delay", "burst", "nonsense"} for fault in step)
    most = sys.maxsize if held else MOST_IN_TRANSIT
    return Excuses(frozenset(reasons), readings=readings, results=results, most=most, until=until)


# --- schedules -------------------------------------------------------------------------------


class Schedule:
    """Generator of a round's steps, which end at most as many processes as a master tolerates."""

    def __init__(self, rng: random.Random, topology: Topology, kinds: list[Kind]) -> None:
        """Draw faults of these kinds for a topology from the random generator."""
        self._rng = rng
        self._topology = topology
        makers: list[tuple[Kind, Callable[[], Step]]] = [
            (Kind.SIGNALS, self._kill),
            (Kind.SIGNALS, self._stop),
            (Kind.SIGNALS, self._pair),
            (Kind.ROSBRIDGE, self._rosbridge),
            (Kind.ROSBRIDGE, self._rosbridge),
            (Kind.INPUT, self._input),
            (Kind.RESOURCES, self._resource),
            (Kind.CLOCK, self._clock),
        ]
        if topology.apart:
            makers += [(Kind.LINKS, self._link), (Kind.LINKS, self._link), (Kind.BOARDS, self._misbehave)]
        self._makers = [maker for kind, maker in makers if kind in kinds]

    def steps(self, count: int) -> list[Step]:
        """Return the steps of a round, fewer than `count` if the limits do not allow more."""
        steps: list[Step] = []
        ends: Counter[str] = Counter()
        for _ in range(20 * count):
            if len(steps) == count or not self._makers:
                break
            step = self._rng.choice(self._makers)()
            cost = Counter(role for fault in step for role in ended_roles(fault))
            if all(ends[role] + cost[role] <= ENDS.get(role, MOST_ENDS) for role in cost):
                ends += cost
                steps.append(step)
        return steps

    def _seconds(self, longest: float) -> float:
        return round(self._rng.uniform(0.05, longest), 2)

    def _kill(self) -> Step:
        return (Fault(Kind.SIGNALS, "kill", self._rng.choice(self._topology.roles)),)

    def _stop(self) -> Step:
        return (Fault(Kind.SIGNALS, "stop", self._rng.choice(self._topology.roles), self._seconds(3)),)

    def _pair(self) -> Step:
        one, other = self._rng.sample(self._topology.roles, 2)
        second = "stop" if self._rng.random() < 0.3 else "kill"
        return (Fault(Kind.SIGNALS, "kill", one), Fault(Kind.SIGNALS, second, other, self._seconds(2)))

    def _rosbridge(self) -> Step:
        what = self._rng.choice(["gone", "hold", "slow", "delay", "nonsense", "cut-inside", "finish"])
        longest = 4.0 if self._rng.random() < 0.9 else 20.0
        number = self._rng.randrange(len(NONSENSE))
        return (Fault(Kind.ROSBRIDGE, what, "rosbridge", self._seconds(longest), number),)

    def _link(self) -> Step:
        services = SERVICES if self._topology is Topology.APART else ()
        target = self._rng.choice((*BOARD_NAMES, *services))
        whats = ["delay", "hold", "cut", "finish", "cut-inside", "slow"]
        if target in BOARD_NAMES:
            whats += ["corrupt", "repeat"]
        return (Fault(Kind.LINKS, self._rng.choice(whats), target, self._seconds(1.5)),)

    def _misbehave(self) -> Step:
        kind = self._rng.randrange(len(MISBEHAVIOURS))
        return (Fault(Kind.BOARDS, "misbehave", self._rng.choice(BOARD_NAMES), number=kind),)

    def _input(self) -> Step:
        what = self._rng.choice(["burst", "nan", "huge", "unusable", "disorder"])
        return (Fault(Kind.INPUT, what, "readings", 0.0, 10_000 if what == "burst" else 50),)

    def _resource(self) -> Step:
        roles = [role for role in self._topology.roles if role not in {*BOARD_NAMES, BOARDS_PARENT}]
        what = self._rng.choice(["files", "memory"])
        return (Fault(Kind.RESOURCES, what, self._rng.choice(roles), self._seconds(2)),)

    def _clock(self) -> Step:
        return (Fault(Kind.CLOCK, "clock", "all", 1.0, self._rng.choice([-3600, 3600])),)


def _text(payload: bytes, opcode: int = 0x81) -> bytes:
    size = len(payload)
    length = bytes([size]) if size < 126 else b"\x7e" + size.to_bytes(2, "big")
    return bytes([opcode]) + length + payload


NONSENSE = (
    _text(b"hello"),
    _text(b"[1, 2, 3]"),
    _text(b"null"),
    _text(b'{"op": "publish", "topic": "/campaign/readings"}'),
    _text(b'{"op": "publish", "topic": "/campaign/others", "msg": {"near": "five", "far": []}}'),
    _text(b'{"op": "fragment", "id": "x", "data": "aaa", "num": 7, "total": 3}'),
    _text(b'{"op": "png", "data": "bm90IGEgcGljdHVyZQ=="}'),
    _text(b"\xa1\x62op\x18", 0x82),
    _text(b"\xff\xfe not UTF-8"),
    _text(b'{"op": "publish", ' + b"[" * 5000),
    b"HTTP/1.1 500 no\r\n\r\n",
    b"\x81\x7f\xff\xff\xff\xff\xff\xff\xff\xff",
)
"""Byte strings that a server inserts between its messages. The last two are not valid WebSocket frames."""
