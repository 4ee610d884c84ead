"""What the stack says on its result topics, and which result belongs to which frame and to which truth.

No connection is in here: messages go in, `Instance`s come out. `/BMresults` carries no stamp; the `/bm/frame`
that was sent just before it does, and it is the stamp of the reading, which the true pose of a simulator
carries too.
"""

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    ValidationError,
)

from bridge.stamps import stamp_ns
from casestudies.errors import BadResultError

RESULTS_TOPIC: Final = "/BMresults"
RESULTS_TYPE: Final = "std_msgs/Float64MultiArray"
FRAME_TOPIC: Final = "/bm/frame"
FRAME_TYPE: Final = "diagnostic_msgs/DiagnosticArray"
TRUTH_TYPE: Final = "geometry_msgs/PoseStamped"

_TRUTHS_KEPT = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class StageTimes:
    """Where a frame's time went, each in microseconds; None where the stack did not say."""

    rosbridge_in: float | None = None
    local_hops: float | None = None
    register_writes: float | None = None
    compute: float | None = None
    reads: float | None = None
    boards_compute: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardReport:
    """What one board did with a frame."""

    name: str
    stopped: str
    cycles: int | None = None
    counts_total: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameReport:
    """A `/bm/frame` message.

    Times called `_ns` are Unix times in nanoseconds: of the reading (`stamp_ns`), of its receipt by the
    subscriber, of the sending of the result, and of the arrival of this message here.
    """

    stamp_ns: int
    heard_ns: int
    outcome: str
    published: bool = True
    number: int | None = None
    cycles: int | None = None
    counts_total: int | None = None
    received_ns: int | None = None
    sent_ns: int | None = None
    stages: StageTimes = StageTimes()
    boards: tuple[BoardReport, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """A `/BMresults` message: probabilities, row-major over the labelled dimensions, the first slowest."""

    values: tuple[float, ...]
    labels: tuple[str, ...]
    sizes: tuple[int, ...]
    heard_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """A true position, in the map's units."""

    stamp_ns: int
    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Instance:
    """A frame with all that was heard of it.

    `posterior` is None for a frame without one, `report` for a result that no `/bm/frame` announced, `truth`
    where no true pose belongs to the stamp. `truth_age_ns` is how much older than the frame's stamp the true
    pose is: 0 where the stamps are equal.
    """

    report: FrameReport | None
    posterior: Posterior | None
    truth: Truth | None = None
    truth_age_ns: int = 0

    @property
    def rosbridge_out_us(self) -> float | None:
        """From the result's sending to its arrival here, in microseconds; None where clocks disagree."""
        return self._since(self.report.sent_ns if self.report else None)

    @property
    def latency_us(self) -> float | None:
        """From the receipt of the reading to the arrival of the result here, in microseconds."""
        return self._since(self.report.received_ns if self.report else None)

    def _since(self, begin_ns: int | None) -> float | None:
        if begin_ns is None or self.posterior is None or self.posterior.heard_ns < begin_ns:
            return None
        return (self.posterior.heard_ns - begin_ns) / 1000


class _Part(BaseModel):
    """A part of a ROS message; fields that are not named here are of no interest."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class _Header(_Part):
    stamp: Annotated[int, BeforeValidator(stamp_ns)]


class _KeyValue(_Part):
    key: str
    value: str


class _Status(_Part):
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: tuple[_KeyValue, ...] = ()


class _DiagnosticArray(_Part):
    header: _Header
    status: Annotated[tuple[_Status, ...], Field(min_length=1)]


class _FrameValues(_Part):
    """The keys of the first status; all may be absent."""

    number: int | None = None
    published: bool = True
    cycles: int | None = None
    counts_total: int | None = None
    received_ns: int | None = None
    sent_ns: int | None = None
    rosbridge_in_us: FiniteFloat | None = None
    local_hops_us: FiniteFloat | None = None
    register_writes_us: FiniteFloat | None = None
    compute_us: FiniteFloat | None = None
    reads_us: FiniteFloat | None = None
    boards_compute_us: FiniteFloat | None = None


class _BoardValues(_Part):
    cycles: int | None = None
    counts_total: int | None = None


class _Dimension(_Part):
    label: str = ""
    size: NonNegativeInt


class _Layout(_Part):
    dim: tuple[_Dimension, ...] = ()
    data_offset: NonNegativeInt = 0


class _Float64MultiArray(_Part):
    layout: _Layout = _Layout()
    data: tuple[Annotated[FiniteFloat, Field(ge=0)], ...]


class _Point(_Part):
    x: FiniteFloat
    y: FiniteFloat


class _Pose(_Part):
    position: _Point


class _PoseStamped(_Part):
    header: _Header
    pose: _Pose


def read_frame_report(message: dict[str, Any], heard_ns: int) -> FrameReport:
    """A diagnostic_msgs/DiagnosticArray from `/bm/frame` as a report.

    Raises:
        BadResultError: it has no stamp or no status, or one of its numbers is none.
    """
    try:
        array = _DiagnosticArray.model_validate(message)
        first, *others = array.status
        values = _FrameValues.model_validate(_by_key(first))
        boards = tuple(_read_board(status) for status in others)
    except ValidationError as error:
        raise BadResultError(_complaint(FRAME_TOPIC, FRAME_TYPE, error)) from None
    return FrameReport(
        stamp_ns=array.header.stamp,
        heard_ns=heard_ns,
        outcome=first.message,
        published=values.published,
        number=values.number,
        cycles=values.cycles,
        counts_total=values.counts_total,
        received_ns=values.received_ns,
        sent_ns=values.sent_ns,
        stages=StageTimes(
            rosbridge_in=values.rosbridge_in_us,
            local_hops=values.local_hops_us,
            register_writes=values.register_writes_us,
            compute=values.compute_us,
            reads=values.reads_us,
            boards_compute=values.boards_compute_us,
        ),
        boards=boards,
    )


def read_posterior(message: dict[str, Any], heard_ns: int) -> Posterior:
    """A std_msgs/Float64MultiArray from `/BMresults` as a posterior.

    Raises:
        BadResultError: a value is no probability, or the layout does not describe the data.
    """
    try:
        array = _Float64MultiArray.model_validate(message)
    except ValidationError as error:
        raise BadResultError(_complaint(RESULTS_TOPIC, RESULTS_TYPE, error)) from None
    values = array.data[array.layout.data_offset :]
    sizes = tuple(dimension.size for dimension in array.layout.dim) or (len(values),)
    cells = 1
    for size in sizes:
        cells *= size
    if cells != len(values) or not values:
        raise BadResultError(
            f"a message on {RESULTS_TOPIC} has {len(values)} values, but its layout says "
            f"{' x '.join(str(size) for size in sizes)}: something else than the master publishes there"
        )
    return Posterior(
        values=values,
        labels=tuple(dimension.label for dimension in array.layout.dim),
        sizes=sizes,
        heard_ns=heard_ns,
    )


def read_truth(message: dict[str, Any], topic: str) -> Truth:
    """A geometry_msgs/PoseStamped as a true position.

    Raises:
        BadResultError: it has no stamp or no position.
    """
    try:
        pose = _PoseStamped.model_validate(message)
    except ValidationError as error:
        raise BadResultError(_complaint(topic, TRUTH_TYPE, error)) from None
    return Truth(stamp_ns=pose.header.stamp, x=pose.pose.position.x, y=pose.pose.position.y)


class Pairing:
    """Puts reports, results and truths together, whatever order they are handed over in.

    Each topic's own messages come in the order of their arrival, so the next result goes to the next report of a
    published frame. `heard_ns` tells when one of the two was lost: a result goes to no report that was heard more
    than `disorder_ns` after it, nor to one that was heard as long before it if the next one was not. Servers keep the
    order of a topic, but not all keep the order between topics. A frame waits for its truth until a
    newer truth or the next frame shows that it won't come. Without a truth of exactly its stamp a frame takes
    the newest older one, if it is not older than `truth_tolerance_ns`: messages without a header (an array
    of numbers) get their stamp only when they reach the host.
    """

    def __init__(self, *, truth_tolerance_ns: int = 0, disorder_ns: int = 0) -> None:
        self.announced_only = 0
        """Reports whose result never came."""
        self._truth_tolerance_ns = truth_tolerance_ns
        self._disorder_ns = disorder_ns
        self._reports: deque[FrameReport] = deque()
        self._posteriors: deque[Posterior] = deque()
        self._truths: deque[Truth] = deque(maxlen=_TRUTHS_KEPT)
        self._untrue: deque[Instance] = deque()  # frames that still wait for their true pose

    @property
    def waits(self) -> bool:
        """Whether there is a result that waits for its report or its truth."""
        return bool(self._posteriors or self._untrue)

    def add_report(self, report: FrameReport) -> list[Instance]:
        """Take a `/bm/frame`; returns the instances that are complete now."""
        self._reports.append(report)
        self._match()
        return self._resolve()

    def add_posterior(self, posterior: Posterior) -> list[Instance]:
        """Take a `/BMresults`; returns the instances that are complete now."""
        self._posteriors.append(posterior)
        self._match()
        return self._resolve()

    def add_truth(self, truth: Truth) -> list[Instance]:
        """Take a true position; returns the instances that are complete now."""
        self._truths.append(truth)
        return self._resolve()

    def flush(self) -> list[Instance]:
        """The results that still wait for a report or a truth: nothing more will come."""
        self._untrue.extend(Instance(report=None, posterior=posterior) for posterior in self._posteriors)
        self._posteriors.clear()
        ended = [self._with_truth(instance) for instance in self._untrue]
        self._untrue.clear()
        return ended

    def _match(self) -> None:
        """Move what belongs together from the queues of reports and posteriors to the untrue."""
        while self._reports or self._posteriors:
            if self._reports and not self._reports[0].published:
                self._untrue.append(Instance(report=self._reports.popleft(), posterior=None))
                continue
            if not self._posteriors or not self._reports:
                return
            posterior = self._posteriors[0]
            if self._reports[0].heard_ns > posterior.heard_ns + self._disorder_ns:  # its own report was lost
                self._untrue.append(Instance(report=None, posterior=self._posteriors.popleft()))
            elif len(self._reports) > 1 and self._belongs_to_a_later(posterior):
                self._reports.popleft()  # its result was lost
                self.announced_only += 1
            else:
                self._untrue.append(
                    Instance(report=self._reports.popleft(), posterior=self._posteriors.popleft())
                )

    def _belongs_to_a_later(self, posterior: Posterior) -> bool:
        """Whether a result came too late to be the first report's, and not too early to be the next one's."""
        first, second = self._reports[0], self._reports[1]
        return (
            first.heard_ns + self._disorder_ns < posterior.heard_ns
            and second.heard_ns <= posterior.heard_ns + self._disorder_ns
        )

    def _resolve(self) -> list[Instance]:
        ready: list[Instance] = []
        while self._untrue:
            stamp_ns = _stamp_of(self._untrue[0])
            waits = (
                stamp_ns is not None
                and len(self._untrue) == 1
                and bool(self._truths)
                and self._truths[-1].stamp_ns < stamp_ns
            )
            if waits:
                break
            ready.append(self._with_truth(self._untrue.popleft()))
        return ready

    def _with_truth(self, instance: Instance) -> Instance:
        stamp_ns = _stamp_of(instance)
        if stamp_ns is None:
            return instance
        for truth in reversed(self._truths):
            age_ns = stamp_ns - truth.stamp_ns
            if age_ns >= 0:
                if age_ns > self._truth_tolerance_ns:
                    break
                return Instance(
                    report=instance.report, posterior=instance.posterior, truth=truth, truth_age_ns=age_ns
                )
        return instance


def _stamp_of(instance: Instance) -> int | None:
    return instance.report.stamp_ns if instance.report else None


def _by_key(status: _Status) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def _read_board(status: _Status) -> BoardReport:
    values = _BoardValues.model_validate(_by_key(status))
    return BoardReport(
        name=status.hardware_id or status.name,
        stopped=status.message,
        cycles=values.cycles,
        counts_total=values.counts_total,
    )


def _complaint(topic: str, type_name: str, error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    place = ".".join(str(step) for step in first["loc"]) or "the message"
    what = f"{place}: {first['msg'][:1].lower()}{first['msg'][1:]}"
    return f"a message on {topic} is not the {type_name} of the master ({what})"
