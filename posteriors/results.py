"""What the stack says on its result topics, and which posterior belongs to which frame.

No connection is in here: messages go in, posteriors with their frames' data come out. `/BMresults` carries no
stamp; the `/bm/frame` that was sent just before it does, and it is the stamp of the reading.
"""

import difflib
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    ValidationError,
)

from bridge.errors import BadResultError, LabelError
from bridge.stamps import stamp_ns

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

RESULTS_TOPIC: Final = "/BMresults"
RESULTS_TYPE: Final = "std_msgs/Float64MultiArray"
#: Bytes of a posterior as JSON at most: of 64 boards with 4096 lines each, 26 a number, and room for the rest.
MAX_RESULT: Final = 1 << 23
FRAME_TOPIC: Final = "/bm/frame"
FRAME_TYPE: Final = "diagnostic_msgs/DiagnosticArray"
REPLICA: Final = "replica"
"""Label of the first dimension where a posterior is one of several replicas'."""

# NumPy has arrays of no more.
_MOST_DIMENSIONS: Final = 32
#: Reports, and posteriors, that wait for their counterparts at most.
WAITING: Final = 256


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
    """What one board did with a frame; where it holds several machines, what each of these did."""

    name: str
    stopped: str
    cycles: int | None = None
    counts_total: int | None = None
    replica_cycles: tuple[int, ...] = ()
    replica_stopped: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameReport:
    """A `/bm/frame` message.

    Times called `_ns` are Unix times in nanoseconds: of the reading (`stamp_ns`), of its receipt by the
    subscriber, of the sending of the result, and of the arrival of this message here.
    """

    stamp_ns: int
    heard_ns: int
    outcome: str
    deployment: str = ""
    published: bool = True
    number: int | None = None
    cycles: int | None = None
    counts_total: int | None = None
    received_ns: int | None = None
    sent_ns: int | None = None
    stages: StageTimes = StageTimes()
    boards: tuple[BoardReport, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """A posterior: a probability for each cell of the searched variables' grid, with its frame's data.

    Attributes:
        probabilities: row-major over the labelled dimensions, the first slowest; they sum to 1. Where the first label
            is `replica`, there are as many posteriors, one after the other; each sums to 1, or is 0 where it has none.
        labels: the searched variables' names, in the order of the dimensions.
        sizes: how many values each has.
        heard_ns: when it arrived here, Unix time in nanoseconds.
        report: its `/bm/frame`; None if that was lost.
    """

    probabilities: tuple[float, ...]
    labels: tuple[str, ...]
    sizes: tuple[int, ...]
    heard_ns: int
    report: FrameReport | None = None

    @cached_property
    def values(self) -> "NDArray[np.float64]":
        """The probabilities as a read-only float64 array of shape `sizes`."""
        import numpy as np

        values = np.array(self.probabilities, np.float64).reshape(self.sizes)
        values.flags.writeable = False
        return values

    @property
    def replicas(self) -> int:
        """How many posteriors of machines of one kind these are: those of a deployment's replicas, or 1."""
        return self.sizes[0] if self.labels[0] == REPLICA else 1

    def replica(self, at: int) -> "Posterior":
        """One replica's posterior by itself, without the dimension of replicas.

        Raises:
            LabelError: there is no such replica, or it has no posterior: no line of it counted.
        """
        if not 0 <= at < self.replicas:
            raise LabelError(f"replica {at} was asked for: there are 0 to {self.replicas - 1}")
        if self.labels[0] != REPLICA:
            return self
        each = len(self.probabilities) // self.replicas
        own = self.probabilities[at * each : (at + 1) * each]
        if not any(own):
            raise LabelError(f"replica {at} has no posterior in this frame: no line of it counted")
        return replace(self, probabilities=own, labels=self.labels[1:], sizes=self.sizes[1:])

    @property
    def number(self) -> int | None:
        """The frame's number, from 1, rising, per master; None if it is not known."""
        return self.report.number if self.report else None

    @property
    def stamp_ns(self) -> int | None:
        """The time of the reading, Unix time in nanoseconds; None if it is not known."""
        return self.report.stamp_ns if self.report else None

    @property
    def cycles(self) -> int | None:
        """Most cycles that any board ran; None if it is not known."""
        return self.report.cycles if self.report else None

    @property
    def stages(self) -> StageTimes:
        """Where the frame's time went, in microseconds."""
        return self.report.stages if self.report else StageTimes()

    @property
    def latency_us(self) -> float | None:
        """From the receipt of the reading by the subscriber to the arrival here, in microseconds.

        None if it is not known, or if the clocks of the two computers show that they disagree.
        """
        return self._since(self.report.received_ns if self.report else None)

    @property
    def rosbridge_out_us(self) -> float | None:
        """From the sending of the posterior to its arrival here, in microseconds; None as for `latency_us`."""
        return self._since(self.report.sent_ns if self.report else None)

    def _since(self, begin_ns: int | None) -> float | None:
        return None if begin_ns is None or self.heard_ns < begin_ns else (self.heard_ns - begin_ns) / 1000

    @property
    def probability(self) -> float:
        """That of the most probable cell."""
        return max(self.probabilities)

    def best(self) -> dict[str, int]:
        """The most probable cell: an index from 0 for each label; of equal ones the first."""
        line = self.probabilities.index(self.probability)
        indices: list[int] = []
        for size in reversed(self.sizes):
            line, index = divmod(line, size)
            indices.append(index)
        return dict(zip(self.labels, reversed(indices), strict=True))

    def mean(self) -> dict[str, float]:
        """The mean index of each label, from 0.

        What an index stands for is in `deployment.toml`: ``offset + index * step``, which is linear, so the mean
        index stands for the mean. Of a variable that goes round (a heading) it says nothing.
        """
        means: dict[str, float] = {}
        for label, size in zip(self.labels, self.sizes, strict=True):
            marginal = self.marginal(label)
            means[label] = float(marginal / marginal.sum() @ range(size))
        return means

    def marginal(self, *labels: str) -> "NDArray[np.float64]":
        """The posterior of some of the searched variables, the others summed out.

        Args:
            labels: whose; each once.

        Returns:
            float64 with one dimension for each label, in the order given.

        Raises:
            LabelError: no such variable is searched; the sentence has the nearest right name.
        """
        kept = [self._dimension(label) for label in labels]
        if len(set(kept)) != len(kept):
            raise LabelError(f"marginal() was asked for {', '.join(labels)}: each label once")
        others = tuple(at for at in range(len(self.sizes)) if at not in kept)
        in_order = sorted(kept)
        summed: NDArray[np.float64] = self.values.sum(axis=others)
        return summed.transpose([in_order.index(at) for at in kept])

    def at(self, indices: Mapping[str, int] | None = None, /, **by_label: int) -> float:
        """The probability of one cell: ``posterior.at(y=3, x=4)``, or of a mapping such as `best` gives.

        Raises:
            LabelError: a label that is none, or one that is not given; an index outside of the grid.
        """
        wanted = dict(indices or {}) | by_label
        for label in wanted:
            self._dimension(label)
        line = 0
        for label, size in zip(self.labels, self.sizes, strict=True):
            index = wanted.get(label, -1)
            if not 0 <= index < size:
                said = f"{label} = {index}" if label in wanted else f"no {label}"
                raise LabelError(f"a cell was asked for with {said}: {label} goes from 0 to {size - 1}")
            line = line * size + index
        return self.probabilities[line]

    def _dimension(self, label: str) -> int:
        if label in self.labels:
            return self.labels.index(label)
        near = difflib.get_close_matches(label, self.labels, 1, 0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(self.labels)}"
        raise LabelError(f"the posterior has no variable {label!r}; {hint}")


Heard = Posterior | FrameReport
"""What is heard of a frame: its posterior, or the report of a frame that has none."""


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


def _listed(value: object) -> object:
    """What stands between commas."""
    return tuple(value.split(",")) if isinstance(value, str) else value


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
    replica_cycles: Annotated[tuple[int, ...], BeforeValidator(_listed)] = ()
    replica_reasons: Annotated[tuple[str, ...], BeforeValidator(_listed)] = ()


class _Dimension(_Part):
    label: str = ""
    size: NonNegativeInt


class _Layout(_Part):
    dim: Annotated[tuple[_Dimension, ...], Field(max_length=_MOST_DIMENSIONS)] = ()
    data_offset: NonNegativeInt = 0


class _Float64MultiArray(_Part):
    layout: _Layout = _Layout()
    data: tuple[Annotated[FiniteFloat, Field(ge=0)], ...]


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
        deployment=first.hardware_id,
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


def read_posterior(message: dict[str, Any], heard_ns: int, topic: str = RESULTS_TOPIC) -> Posterior:
    """A std_msgs/Float64MultiArray from `/BMresults` as a posterior; without a layout its only label is `cell`.

    Raises:
        BadResultError: a value is no probability, or the layout does not describe the data.
    """
    try:
        array = _Float64MultiArray.model_validate(message)
    except ValidationError as error:
        raise BadResultError(_complaint(topic, RESULTS_TYPE, error)) from None
    values = array.data[array.layout.data_offset :]
    dimensions = array.layout.dim or (_Dimension(label="cell", size=len(values)),)
    sizes = tuple(dimension.size for dimension in dimensions)
    labels = tuple(dimension.label for dimension in dimensions)
    if math.prod(sizes) != len(values) or not values:
        raise BadResultError(
            f"a message on {topic} has {len(values)} values, but its layout says "
            f"{' x '.join(str(size) for size in sizes)}: something else than the master publishes there"
        )
    if len(set(labels)) != len(labels):
        raise BadResultError(f"a message on {topic} has two dimensions of one name among {', '.join(labels)}")
    if not 0 < sum(values) < math.inf:
        raise BadResultError(f"a message on {topic} has no probability in any of its {len(values)} values")
    return Posterior(probabilities=values, labels=labels, sizes=sizes, heard_ns=heard_ns)


class Pairing:
    """Puts posteriors and the reports of their frames together, whatever order they are handed over in.

    Each topic's own messages come in the order of their arrival, so the next posterior goes to the next report of a
    published frame. `heard_ns` tells when one of the two was lost: a posterior goes to no report that was heard more
    than `disorder_ns` after it, nor to one that was heard as long before it if the next one was not. Servers keep the
    order of a topic, but not all keep the order between topics.

    Attributes:
        announced_only: reports whose posterior never came.
    """

    def __init__(self, *, disorder_ns: int = 0) -> None:
        self.announced_only = 0
        self._disorder_ns = disorder_ns
        self._reports: deque[FrameReport] = deque()
        self._posteriors: deque[Posterior] = deque()

    @property
    def waits(self) -> bool:
        """Whether there is a posterior that waits for its report."""
        return bool(self._posteriors)

    def add_report(self, report: FrameReport) -> list[Heard]:
        """Take a `/bm/frame`; returns what is complete now."""
        self._reports.append(report)
        if len(self._reports) > WAITING:  # nobody publishes posteriors where they are listened for
            self._reports.popleft()
            self.announced_only += 1
        return self._match()

    def add_posterior(self, posterior: Posterior) -> list[Heard]:
        """Take a `/BMresults`; returns what is complete now."""
        self._posteriors.append(posterior)
        ready = self._match()
        if len(self._posteriors) > WAITING:
            ready.append(self._posteriors.popleft())
        return ready

    def flush(self) -> list[Heard]:
        """The posteriors that still wait for a report: none will come."""
        ended: list[Heard] = list(self._posteriors)
        self._posteriors.clear()
        return ended

    def _match(self) -> list[Heard]:
        ready: list[Heard] = []
        while self._reports or self._posteriors:
            if self._reports and not self._reports[0].published:
                ready.append(self._reports.popleft())
                continue
            if not self._posteriors or not self._reports:
                break
            posterior = self._posteriors[0]
            if self._reports[0].heard_ns > posterior.heard_ns + self._disorder_ns:  # its own report was lost
                ready.append(self._posteriors.popleft())
            elif len(self._reports) > 1 and self._belongs_to_a_later(posterior):
                self._reports.popleft()  # its posterior was lost
                self.announced_only += 1
            else:
                ready.append(replace(self._posteriors.popleft(), report=self._reports.popleft()))
        return ready

    def _belongs_to_a_later(self, posterior: Posterior) -> bool:
        """Whether a posterior came too late to be the first report's, and not too early to be the next one's."""
        first, second = self._reports[0], self._reports[1]
        return (
            first.heard_ns + self._disorder_ns < posterior.heard_ns
            and second.heard_ns <= posterior.heard_ns + self._disorder_ns
        )


def _by_key(status: _Status) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def _read_board(status: _Status) -> BoardReport:
    values = _BoardValues.model_validate(_by_key(status))
    return BoardReport(
        name=status.hardware_id or status.name,
        stopped=status.message,
        cycles=values.cycles,
        counts_total=values.counts_total,
        replica_cycles=values.replica_cycles,
        replica_stopped=values.replica_reasons,
    )


def _complaint(topic: str, type_name: str, error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    place = ".".join(str(step) for step in first["loc"]) or "the message"
    what = f"{place}: {first['msg'][:1].lower()}{first['msg'][1:]}"
    return f"a message on {topic} is not the {type_name} of the master ({what})"
