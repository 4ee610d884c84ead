"""Faults of a campaign: their kinds, their permitted losses, and seeded schedules."""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from enum import StrEnum

from scripts.campaigning.judging.accounts import MOST_IN_TRANSIT, Excuses
from scripts.campaigning.stack import BOARD_NAMES, BOARDS_PARENT, SERVICES, Topology


class Kind(StrEnum):
    """A kind of fault, as named with `--only`."""

    SIGNALS = "signals"
    ROSBRIDGE = "rosbridge"
    LINKS = "links"
    BOARDS = "boards"
    RESOURCES = "resources"
    CLOCK = "clock"
    INPUT = "input"
    CONTAINERS = "containers"
    """Faults of containers alone: without network, restarted, or with full run directories."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: kind, action, target, duration, and a number whose meaning depends on the action."""

    kind: str
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
BOARD_ENDS = 3
"""Frames of a round that may fail on boards: the fourth within a minute ends a master by design."""
ENDS = {"master": 1, "hub": 2, "boards": BOARD_ENDS}
MOST_ENDS = 2
"""Number of times per round that a process of another role, or its connection to the master, may be ended."""
MISBEHAVIOURS = (
    *("drop", "stall", "short-read", "endless", "wrong-sequence"),
    *("wrong-crc", "all-ones", "never-done", "done-twice", "done-early", "stale-result"),
)
_FAILS = {"kill", "corrupt", "repeat", "cut", "finish", "cut-inside", "misbehave"}
_ENDS_LINK = {
    "kill",
    "corrupt",
    "repeat",
    "cut",
    "finish",
    "cut-inside",
    "memory",
    "restart",
    "full",
    "cut-off",
}
_CUTS_ROSBRIDGE = {"gone", "finish", "nonsense", "cut-inside", "files"}


SHORT: tuple[Step, ...] = (
    (Fault(Kind.SIGNALS, "kill", "pcie-app"),),
    (Fault(Kind.LINKS, "cut", "board0"),),
    (Fault(Kind.SIGNALS, "stop", "publisher", 0.5),),
    (Fault(Kind.BOARDS, "misbehave", "board1", 0.5, MISBEHAVIOURS.index("wrong-crc")),),
    (Fault(Kind.ROSBRIDGE, "gone", "rosbridge", 0.5),),
    (Fault(Kind.SIGNALS, "kill", "subscriber"),),
    (Fault(Kind.LINKS, "cut-inside", "publisher", 0.3, 1),),
    (Fault(Kind.SIGNALS, "kill", "hub"),),
)
"""The steps of `--short`, for a stack whose parts the campaign starts."""


def ended_roles(fault: Fault) -> tuple[str, ...]:
    """Return the roles whose limit of ends a fault uses up by one; a board's failed frame is such an end."""
    if fault.target == BOARDS_PARENT and fault.what in {"kill", "restart", "full"}:
        return ("boards",)
    if fault.what == "misbehave":
        return ("boards", "boards")  # it has been killed before
    if fault.target in BOARD_NAMES and fault.what in {*_FAILS, "stop", "hold"}:
        return ("boards",)
    return (fault.target,) if fault.what in _ENDS_LINK and fault.target != "rosbridge" else ()


def excuses_of(step: Step, topology: Topology) -> Excuses:
    """Return the losses of a step that the stack cannot count, because no process had the message."""
    readings = results = False
    for fault in step:
        cut = fault.target == "rosbridge" and fault.what in _CUTS_ROSBRIDGE
        ended = fault.target if fault.what in _ENDS_LINK else ""
        fused = topology.fused and ended == "master"
        readings |= cut or fused or ended in {"hub", "master", "subscriber"}
        results |= cut or fused or ended in {"hub", "master", "publisher"}
        if fault.what == "files":
            readings = results = True
    held = any(fault.what in {"stop", "hold", "slow", "delay", "burst", "cut-off"} for fault in step)
    return Excuses(readings=readings, results=results, most=sys.maxsize if held else MOST_IN_TRANSIT)


class Schedule:
    """Generator of a round's steps, within the limits of ends that a master tolerates."""

    def __init__(self, rng: random.Random, topology: Topology, kinds: list[Kind]) -> None:
        """Draw faults of these kinds for a topology from the random generator."""
        self._rng = rng
        self._topology = topology
        services = () if topology.fused else SERVICES
        parent = () if topology.apart else (BOARDS_PARENT,)
        boards = () if topology is Topology.CONTAINERS else BOARD_NAMES
        self._roles = ("hub", *parent, *boards, *services, "master")
        self._makers: list[tuple[Kind, Callable[[], Step]]] = [
            (Kind.SIGNALS, self._kill),
            (Kind.SIGNALS, self._stop),
            (Kind.SIGNALS, self._pair),
            (Kind.ROSBRIDGE, self._rosbridge),
            (Kind.ROSBRIDGE, self._rosbridge),
            (Kind.INPUT, self._input),
            (Kind.RESOURCES, self._resource),
        ]
        if topology.apart:
            self._makers += [
                (Kind.LINKS, self._link),
                (Kind.LINKS, self._link),
                (Kind.BOARDS, self._misbehave),
            ]
        if topology is Topology.CONTAINERS:
            # processes of containers cannot be limited from outside
            self._makers = [(kind, maker) for kind, maker in self._makers if kind is not Kind.RESOURCES]
            self._makers += 2 * [(Kind.CONTAINERS, self._contain)]
        self._makers = [(kind, maker) for kind, maker in self._makers if kind in kinds]
        if Kind.CLOCK in kinds and topology is not Topology.CONTAINERS:
            self._makers.append((Kind.CLOCK, self._clock))

    def steps(self, count: int) -> list[Step]:
        """Return the steps of a round, fewer than `count` if the limits do not allow more."""
        steps: list[Step] = []
        ends: Counter[str] = Counter()
        for _ in range(20 * count):
            if len(steps) == count or not self._makers:
                break
            step = self._rng.choice(self._makers)[1]()
            cost = Counter(role for fault in step for role in ended_roles(fault))
            if all(ends[role] + cost[role] <= ENDS.get(role, MOST_ENDS) for role in cost):
                ends += cost
                steps.append(step)
        return steps

    def _seconds(self, longest: float) -> float:
        return round(self._rng.uniform(0.05, longest), 2)

    def _kill(self) -> Step:
        return (Fault(Kind.SIGNALS, "kill", self._rng.choice(self._roles)),)

    def _stop(self) -> Step:
        return (Fault(Kind.SIGNALS, "stop", self._rng.choice(self._roles), self._seconds(3)),)

    def _pair(self) -> Step:
        one, other = self._rng.sample(self._roles, 2)
        second = self._stop if self._rng.random() < 0.3 else self._kill
        return (
            Fault(Kind.SIGNALS, "kill", one),
            Fault(Kind.SIGNALS, second()[0].what, other, self._seconds(2)),
        )

    def _rosbridge(self) -> Step:
        what = self._rng.choice(["gone", "hold", "slow", "delay", "nonsense", "cut-inside", "finish"])
        longest = 4.0 if self._rng.random() < 0.9 else 20.0
        return (
            Fault(
                Kind.ROSBRIDGE, what, "rosbridge", self._seconds(longest), self._rng.randrange(len(NONSENSE))
            ),
        )

    def _link(self) -> Step:
        names = (*BOARD_NAMES, *(SERVICES if self._topology is Topology.APART else ()))
        target = self._rng.choice(names)
        whats = ["delay", "hold", "cut", "finish", "cut-inside", "slow"]
        if target in BOARD_NAMES:
            whats += ["corrupt", "repeat"]
        return (Fault(Kind.LINKS, self._rng.choice(whats), target, self._seconds(1.5), 1),)

    def _misbehave(self) -> Step:
        kind = self._rng.randrange(len(MISBEHAVIOURS))
        return (Fault(Kind.BOARDS, "misbehave", self._rng.choice(BOARD_NAMES), 0.5, kind),)

    def _input(self) -> Step:
        what = self._rng.choice(["burst", "nan", "huge", "unusable", "disorder"])
        return (Fault(Kind.INPUT, what, "readings", 0.0, 10_000 if what == "burst" else 50),)

    def _resource(self) -> Step:
        roles = [role for role in self._roles if role not in {*BOARD_NAMES, BOARDS_PARENT}]
        what = self._rng.choice(["files", "memory"])
        return (Fault(Kind.RESOURCES, what, self._rng.choice(roles), self._seconds(2)),)

    def _contain(self) -> Step:
        what = self._rng.choice(["cut-off", "restart", "full"])
        roles = {"cut-off": ("subscriber", "publisher"), "full": (BOARDS_PARENT, *SERVICES)}
        longest = 12 if what == "cut-off" else 2
        target = self._rng.choice(roles.get(what, self._roles))
        return (Fault(Kind.CONTAINERS, what, target, self._seconds(longest)),)

    def _clock(self) -> Step:
        return (Fault(Kind.CLOCK, "clock", "all", 1.0, self._rng.choice([-3600, 3600])),)


def _text(payload: bytes, opcode: int = 0x81) -> bytes:
    size = len(payload)
    return (
        bytes([opcode, size]) + payload
        if size < 126
        else bytes([opcode, 126]) + size.to_bytes(2, "big") + payload
    )


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
"""Bytes that a server inserts between its messages; the last ones are not WebSocket frames."""


def step_as_json(step: Step) -> list[dict[str, object]]:
    """Return a step as JSON for a file."""
    return [asdict(fault) for fault in step]
