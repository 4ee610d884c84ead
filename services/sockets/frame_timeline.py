"""The timeline of one frame: its stages and boards, as a master reports them over HTTP."""

import msgspec


class StageSpan(msgspec.Struct, frozen=True):
    """A stage of a frame: the process, its begin after the receipt of the reading, and its duration."""

    stage: str
    where: str
    began_ms: float
    took_ms: float


class BoardOutcome(msgspec.Struct, frozen=True):
    """The cycles of a board, and why it stopped."""

    index: int
    cycles: int
    stopped: str


class FrameTimeline(msgspec.Struct, frozen=True, kw_only=True):
    """One frame in the order of its stages, which are those that it has reached.

    `outcome` is published, the reason of a loss, or where the frame is now; `why` is the sentence of a board
    that failed. `local_hops_ms` is the time between the processes, and `total_ms` the whole latency; both are
    None without a result.
    """

    number: int
    outcome: str
    why: str
    bank: int
    stamp_ns: int
    received_ns: int
    stages: list[StageSpan]
    local_hops_ms: float | None
    total_ms: float | None
    cycles: int | None
    boards: list[BoardOutcome]
