"""A frame's time by stage: means and shares, as in the thesis's figure 4.5."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from statistics import fmean
from typing import Final

from casestudies.truths import Instance


class StageKind(StrEnum):
    """The parts of the system that the thesis measured, and the host's sockets, which it did not measure."""

    ROSBRIDGE = "rosbridge"
    HOST = "between the host's processes"
    REGISTERS = "registers of the boards"
    COMPUTING = "computing on the boards"


@dataclass(frozen=True, slots=True, kw_only=True)
class StageShare:
    """One stage of a frame: its mean over the frames that report it, and its share of all stages."""

    name: str
    part: StageKind
    mean_us: float
    share: float


def _reported(field: str) -> Callable[[Instance], float | None]:
    def time_of(instance: Instance) -> float | None:
        time: float | None = getattr(instance.report.stages, field) if instance.report else None
        return time

    return time_of


def _rosbridge_out(instance: Instance) -> float | None:
    return instance.posterior.rosbridge_out_us if instance.posterior else None


_STAGES: Final[tuple[tuple[str, StageKind, Callable[[Instance], float | None]], ...]] = (
    ("rosbridge in", StageKind.ROSBRIDGE, _reported("rosbridge_in")),
    ("local hops", StageKind.HOST, _reported("local_hops")),
    ("register writes", StageKind.REGISTERS, _reported("register_writes")),
    ("computing", StageKind.COMPUTING, _reported("compute")),
    ("register reads", StageKind.REGISTERS, _reported("reads")),
    ("rosbridge out", StageKind.ROSBRIDGE, _rosbridge_out),
)


def stage_shares(instances: Iterable[Instance]) -> tuple[StageShare, ...]:
    """Return the stages in order, without those that no published frame reports.

    `rosbridge out` is measured here, from the sending of a result to its arrival; the others come from
    `/bm/frame`.
    """
    published = [instance for instance in instances if instance.posterior is not None]
    means: list[tuple[str, StageKind, float]] = []
    for name, part, time_of in _STAGES:
        known = [time for time in map(time_of, published) if time is not None]
        if known:
            means.append((name, part, fmean(known)))
    total = sum(mean for _, _, mean in means)
    return tuple(
        StageShare(name=name, part=part, mean_us=mean, share=mean / total if total else 0.0)
        for name, part, mean in means
    )
