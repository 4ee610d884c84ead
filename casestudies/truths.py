"""True positions, matched with frames by time stamp."""

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, FiniteFloat, ValidationError

from bridge.stamps import stamp_ns
from posteriors.errors import BadResultError
from posteriors.frame_report import FrameReport
from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior

TRUTH_TYPE: Final = "geometry_msgs/PoseStamped"

_TRUTHS_KEPT = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """A true position, in the map's units."""

    stamp_ns: int
    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Instance:
    """A frame's outcome and its true position.

    `truth` is None if no true pose matches the stamp. `truth_age_ns` is the age of the true pose relative to the
    frame's stamp, 0 if the stamps are equal.
    """

    heard: FrameOutcome
    truth: Truth | None = None
    truth_age_ns: int = 0

    @property
    def posterior(self) -> Posterior | None:
        """The posterior, or None for a frame without one."""
        return self.heard if isinstance(self.heard, Posterior) else None

    @property
    def report(self) -> FrameReport | None:
        """The report, or None for a posterior that no `/bm/frame` announced."""
        return self.heard.report if isinstance(self.heard, Posterior) else self.heard


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _Header(_Part):
    stamp: Annotated[int, BeforeValidator(stamp_ns)]


class _Point(_Part):
    x: FiniteFloat
    y: FiniteFloat


class _Pose(_Part):
    position: _Point


class _PoseStamped(_Part):
    header: _Header
    pose: _Pose


def read_truth(message: dict[str, Any], topic: str) -> Truth:
    """Return a geometry_msgs/PoseStamped as a true position, or raise a BadResultError."""
    try:
        pose = _PoseStamped.model_validate(message)
    except ValidationError as error:
        place = ".".join(str(step) for step in error.errors()[0]["loc"])
        raise BadResultError(
            f"a message on {topic} is not the {TRUTH_TYPE} of a simulator ({place or 'the message'} is wrong)"
        ) from None
    return Truth(stamp_ns=pose.header.stamp, x=pose.pose.position.x, y=pose.pose.position.y)


class Truths:
    """Frames and true positions, matched in any order of arrival.

    A frame waits for its truth until a newer truth or the next frame arrives. If no truth has exactly the
    frame's stamp, the newest older one is used, if it is at most `tolerance_ns` older: a message without a
    header is stamped only when it reaches the host.
    """

    def __init__(self, *, tolerance_ns: int = 0) -> None:
        self._tolerance_ns = tolerance_ns
        self._truths: deque[Truth] = deque(maxlen=_TRUTHS_KEPT)
        self._untrue: deque[Instance] = deque()  # frames that still wait for their true pose

    @property
    def waits(self) -> bool:
        """True while a frame waits for its truth."""
        return bool(self._untrue)

    def add_frame(self, heard: FrameOutcome) -> list[Instance]:
        """Add a frame's outcome and return the instances that are now complete."""
        self._untrue.append(Instance(heard=heard))
        return self._resolve()

    def add_truth(self, truth: Truth) -> list[Instance]:
        """Add a true position and return the instances that are now complete."""
        self._truths.append(truth)
        return self._resolve()

    def flush(self) -> list[Instance]:
        """Return the frames that still wait for a truth that will not arrive."""
        ended = [self._with_truth(instance) for instance in self._untrue]
        self._untrue.clear()
        return ended

    def _resolve(self) -> list[Instance]:
        ready: list[Instance] = []
        while self._untrue:
            report = self._untrue[0].report
            waits = (
                report is not None
                and len(self._untrue) == 1
                and bool(self._truths)
                and self._truths[-1].stamp_ns < report.stamp_ns
            )
            if waits:
                break
            ready.append(self._with_truth(self._untrue.popleft()))
        return ready

    def _with_truth(self, instance: Instance) -> Instance:
        if instance.report is None:
            return instance
        for truth in reversed(self._truths):
            age_ns = instance.report.stamp_ns - truth.stamp_ns
            if age_ns >= 0:
                if age_ns > self._tolerance_ns:
                    break
                return Instance(heard=instance.heard, truth=truth, truth_age_ns=age_ns)
        return instance
