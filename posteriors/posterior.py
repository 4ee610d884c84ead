"""Posteriors as labelled arrays: display in notebooks, and conversion from and to messages on `/BMresults`."""

import base64
import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import Field, FiniteFloat, NonNegativeInt, TypeAdapter

from posteriors.axes import Axis, deployment_axes, in_words, printable
from posteriors.errors import BadResultError, LabelError
from posteriors.frame_report import FrameReport, StageTimes
from posteriors.messages import Part, validated

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from toolchain.deployment import Deployment, Dimension

RESULTS_TOPIC: Final = "/BMresults"
RESULTS_TYPE: Final = "std_msgs/Float64MultiArray"
SAMPLES_TOPIC: Final = "/bm/samples"
SAMPLES_TYPE: Final = "std_msgs/UInt8MultiArray"
MAX_RESULT: Final = 1 << 23
"""Maximum size in bytes of a posterior as JSON, sufficient for 64 boards of 4096 cells with 26 bytes per number."""
REPLICA: Final = "replica"
"""Label of the first dimension if an array contains the posteriors of several replicas."""

_MAX_DIMENSIONS: Final = 32
"""Maximum number of dimensions of a NumPy array."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Posterior:
    """A posterior: a probability for each cell of the searched variables' grid, with the data of its frame.

    A notebook shows it as a table with bars or a map.
    """

    probabilities: tuple[float, ...]
    """Probabilities of all cells, in row-major order over the dimensions of `labels`.

    Without replicas, the sum is 1. With replicas, the first label is `replica`, and the posteriors of the replicas
    follow each other. The sum of each replica's posterior is 1, or 0 if all counts of the replica are 0.
    """
    labels: tuple[str, ...]
    """Names of the dimensions: those of the searched variables, after `replica` if there are several replicas."""
    sizes: tuple[int, ...]
    """Number of values of each dimension."""
    heard_ns: int
    """Time of arrival in this process (Unix time in nanoseconds)."""
    report: FrameReport | None = None
    """The frame's report from `/bm/frame`, or None if the report was lost."""
    details: Mapping[str, str] = field(default_factory=dict)
    """Statistics of a BM2's samples, by their keys in `/bm/frame`; empty for a BM1."""
    dimensions: "tuple[Dimension, ...]" = ()
    """For each label, its unit and the names of its states. Empty if the deployment is not known; see `with_units`."""

    @cached_property
    def values(self) -> "NDArray[np.float64]":
        """Probabilities as a read-only float64 array of shape `sizes`."""
        import numpy as np

        values = np.array(self.probabilities, np.float64).reshape(self.sizes)
        values.flags.writeable = False
        return values

    @property
    def replicas(self) -> int:
        """Number of posteriors in this object, one for each replica of the deployment."""
        return self.sizes[0] if self.labels[0] == REPLICA else 1

    def replica(self, at: int) -> "Posterior":
        """Return the posterior of replica `at`, without the label `replica`.

        Raises a LabelError if there is no replica `at`, or if all counts of the replica are 0.
        """
        if not 0 <= at < self.replicas:
            raise LabelError(f"there is no replica {at}: expected 0 to {self.replicas - 1}")
        if self.labels[0] != REPLICA:
            return self
        each = len(self.probabilities) // self.replicas
        own = self.probabilities[at * each : (at + 1) * each]
        if not any(own):
            raise LabelError(f"replica {at} has no posterior in this frame: all its counts are 0")
        return replace(
            self,
            probabilities=own,
            labels=self.labels[1:],
            sizes=self.sizes[1:],
            dimensions=self.dimensions[1:],
        )

    def with_units(self, deployment: "Deployment | Path | str") -> "Posterior":
        """Return this posterior with the units and the names of states of a deployment.

        `deployment` is the deployment or its folder.

        Raises:
            LabelError: The posteriors of the deployment have other dimensions than this posterior.
            ToolchainError: There is no deployment in the folder.
        """
        from toolchain.deployment import Deployment, load_deployment

        if not isinstance(deployment, Deployment):
            deployment = load_deployment(Path(deployment), images=False)
        ours = [(axis.label, axis.size) for axis in deployment_axes(deployment)]
        # another deployment's values would be shown with plausible units
        if (theirs := list(zip(self.labels, self.sizes, strict=True))) != ours:
            raise LabelError(
                f"the received posterior has {_grid(theirs)}, but the deployment of {deployment.directory} has {_grid(ours)}; "
                "name the deployment that publishes them"
            )
        return replace(self, dimensions=deployment.result_dimensions)

    @property
    def axes(self) -> list[Axis]:
        """The dimensions, with units and names of states if they are known."""
        known = self.dimensions or (None,) * len(self.labels)
        return [Axis(*each) for each in zip(self.labels, self.sizes, known, strict=True)]

    @property
    def number(self) -> int | None:
        """Number of the frame, or None if unknown. Each master counts from 1."""
        return self.report.number if self.report else None

    @property
    def stamp_ns(self) -> int | None:
        """Time of the reading (Unix time in nanoseconds), or None if unknown."""
        return self.report.stamp_ns if self.report else None

    @property
    def cycles(self) -> int | None:
        """Number of cycles of the board with the most cycles, or None if unknown."""
        return self.report.cycles if self.report else None

    @property
    def stages(self) -> StageTimes:
        """Durations of the stages of the frame, in microseconds."""
        return self.report.stages if self.report else StageTimes()

    @property
    def latency_us(self) -> float | None:
        """Microseconds from the reading's receipt in the subscriber to the posterior's arrival in this process.

        None if unknown, or if the clocks of the two computers differ too much.
        """
        return self._since(self.report.received_ns if self.report else None)

    @property
    def rosbridge_out_us(self) -> float | None:
        """Microseconds from the sending of the posterior to its arrival here.

        None if unknown, or if the clocks of the two computers differ too much.
        """
        return self._since(self.report.sent_ns if self.report else None)

    def _since(self, begin_ns: int | None) -> float | None:
        return None if begin_ns is None or self.heard_ns < begin_ns else (self.heard_ns - begin_ns) / 1000

    @property
    def probability(self) -> float:
        """Probability of the most probable cell."""
        return max(self.probabilities)

    def best(self) -> dict[str, int]:
        """Return the most probable cell as an index from 0 for each label. Of several equal cells, return the first."""
        line = self.probabilities.index(self.probability)
        indices: list[int] = []
        for size in reversed(self.sizes):
            line, index = divmod(line, size)
            indices.append(index)
        return dict(zip(self.labels, reversed(indices), strict=True))

    def mean(self) -> dict[str, float]:
        """Return the mean index of each label. Indices start at 0.

        An index stands for the value `offset + index * step` (`deployment.toml`), so the mean index gives the mean
        value. The mean of a periodic variable, such as a heading, is not meaningful.
        """
        means: dict[str, float] = {}
        for label, size in zip(self.labels, self.sizes, strict=True):
            marginal = self.marginal(label)
            means[label] = float(marginal / marginal.sum() @ range(size))
        return means

    def best_value(self) -> dict[str, float | str]:
        """Return the most probable cell: for each label, a value in the label's unit or the name of a state.

        Raises:
            LabelError: The deployment that produced the posterior is not known.
        """
        best = self.best()
        return {axis.label: axis.value(best[axis.label]) for axis in self._known_axes()}

    def mean_value(self) -> dict[str, float | str]:
        """Return the mean of each label in the label's unit. Labels with named states are left out.

        Raises:
            LabelError: The deployment is not known.
        """
        mean = self.mean()
        return {
            axis.label: axis.value(mean[axis.label]) for axis in self._known_axes() if not axis.has_states
        }

    def _known_axes(self) -> list[Axis]:
        if not self.dimensions:
            raise LabelError(
                "the units of this posterior are not known: use best() and mean(), which are indices, or "
                "with_units(FOLDER) with the folder of its deployment"
            )
        return self.axes

    @property
    def entropy(self) -> float:
        """Entropy in bits: 0 if one cell is certain, log2 of the number of cells if all are equally probable."""
        import numpy as np

        likely = self.values[self.values > 0] / self.values.sum()
        return abs(float((likely * np.log2(likely)).sum()))

    def total_variation(self, other: "Posterior") -> float:
        """Return half the sum of the absolute differences, 0 to 1. Raises a LabelError if the dimensions differ."""
        import numpy as np

        ours, theirs = (list(zip(each.labels, each.sizes, strict=True)) for each in (self, other))
        if ours != theirs:
            raise LabelError(f"the posteriors have different dimensions: {_grid(ours)} and {_grid(theirs)}")
        return float(np.abs(self.values - other.values).sum() / 2)

    def marginal(self, *labels: str) -> "NDArray[np.float64]":
        """Return the marginal posterior of some searched variables.

        The float64 array has one dimension for each label, in the order given.

        Raises:
            LabelError: A label is named twice, or is not searched. The message suggests a similar name.
        """
        kept = [self._dimension(label) for label in labels]
        if len(set(kept)) != len(kept):
            raise LabelError(f"marginal() expects each label once, but got {', '.join(labels)}")
        others = tuple(at for at in range(len(self.sizes)) if at not in kept)
        in_order = sorted(kept)
        summed: NDArray[np.float64] = self.values.sum(axis=others)
        return summed.transpose([in_order.index(at) for at in kept])

    def at(self, indices: Mapping[str, int] | None = None, /, **by_label: int) -> float:
        """Return the probability of one cell: `posterior.at(y=3, x=4)` or `posterior.at(posterior.best())`.

        Raises:
            LabelError: A label is unknown or missing, or an index is outside the grid.
        """
        wanted = dict(indices or {}) | by_label
        for label in wanted:
            self._dimension(label)
        line = 0
        for label, size in zip(self.labels, self.sizes, strict=True):
            index = wanted.get(label, -1)
            if not 0 <= index < size:
                given = f"{label} = {index}" if label in wanted else f"no {label}"
                raise LabelError(f"there is no cell with {given}: {label} goes from 0 to {size - 1}")
            line = line * size + index
        return self.probabilities[line]

    def __repr__(self) -> str:
        best = f"{in_words(self.axes, self.best())} with {self.probability:.3g}"
        return f"<Posterior over {' x '.join(map(str, self.sizes))} cells: most probable {best}>"

    def _repr_html_(self) -> str:
        """Return the table and the picture that a notebook shows."""
        from posteriors.showing import as_html

        if self.replicas > 1:
            return f"<p>{self.replicas} replicas, each with a posterior: replica(0) returns the first</p>"
        facts = [
            f"probability of the most probable cell: {self.probability:.4g}",
            f"entropy: {self.entropy:.2f} of {math.log2(len(self.probabilities)):.2f} bits",
        ]
        if self.number is not None:
            facts.append(f"frame {self.number}")
        if self.cycles is not None:
            facts.append(f"{self.cycles:,} cycles")
        facts += [
            f"{printable(key).replace('_', ' ')}: {printable(text)}" for key, text in self.details.items()
        ]
        return as_html(self.axes, self.values, facts)

    def plot(self, axes: Any = None) -> Any:
        """Draw bars for one dimension, or otherwise a map of the two longest dimensions.

        The map sums over the remaining dimensions.

        Args:
            axes: matplotlib's Axes to draw in. Without Axes, pyplot makes a figure, and a notebook shows the figure.

        Returns:
            The Axes.

        Raises:
            LabelError: The object contains the posteriors of several replicas.
        """
        from posteriors.showing import draw

        if self.replicas > 1:
            raise LabelError(
                f"these are the posteriors of {self.replicas} replicas: draw one, such as replica(0).plot()"
            )
        return draw(self.axes, self.values, axes)

    def _dimension(self, label: str) -> int:
        if label in self.labels:
            return self.labels.index(label)
        near = difflib.get_close_matches(label, self.labels, 1, 0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(self.labels)}"
        raise LabelError(f"the posterior has no variable {label!r}; {hint}")


def _grid(dimensions: Iterable[tuple[str, int]]) -> str:
    return " x ".join(f"{printable(label)} {size}" for label, size in dimensions)


def posterior_layout(deployment: "Deployment") -> dict[str, Any]:
    """Return the `layout` of messages with a deployment's posteriors: labels, sizes and row-major strides.

    With several replicas, the first dimension is labelled `replica`.
    """
    dimensions = []
    stride = deployment.machine.results
    for dimension in deployment.result_dimensions:
        dimensions.append({"label": dimension.label, "size": dimension.size, "stride": stride})
        stride //= dimension.size
    return {"dim": dimensions, "data_offset": 0}


def samples_layout(samples: int, sample_bytes: int) -> dict[str, Any]:
    """Return the `layout` of a message on `/bm/samples`: a row of bytes for each sampled state."""
    rows = {"label": "sample", "size": samples, "stride": samples * sample_bytes}
    words = "one little-endian word" if sample_bytes == 4 else f"{sample_bytes // 4} little-endian words"
    state = {"label": f"byte of {words}", "size": sample_bytes, "stride": sample_bytes}
    return {"dim": [rows, state], "data_offset": 0}


def read_samples(message: dict[str, Any], sizes: Sequence[int] = (), newest: int = 0) -> "NDArray[np.int64]":
    """Return the sampled states in a message on `/bm/samples` as values of variables, int64[samples, variables].

    `sizes` has the number of values of each variable, in the order of the machine. If a sampled value is not below
    the variable's size, it is an unused code. Without sizes, return the machine words of the states,
    int64[samples, words]. If `newest` is not 0, return only the newest samples, at most `newest` of them.

    Raises:
        BadResultError: The message does not hold states of this machine.
    """
    import numpy as np

    from machines.bm2 import unpack_all

    try:
        size, data = int(message["layout"]["dim"][1]["size"]), message["data"]
        # a list, because bytes(10**12) would be a terabyte
        octets = base64.b64decode(data) if isinstance(data, str) else bytes(list(data))
        words = np.frombuffer(octets, "<u4").reshape(-1, size // 4)[-newest:]
        return unpack_all(tuple(sizes), words) if sizes else words.astype(np.int64)
    except (ArithmeticError, LookupError, TypeError, ValueError):
        raise BadResultError(
            f"a message on {SAMPLES_TOPIC} does not hold the states of this machine"
        ) from None


class _Dimension(Part):
    label: str = ""
    size: NonNegativeInt


class _Layout(Part):
    dim: Annotated[tuple[_Dimension, ...], Field(max_length=_MAX_DIMENSIONS)] = ()
    data_offset: NonNegativeInt = 0


class _Float64MultiArray(Part):
    layout: _Layout = _Layout()
    data: tuple[Annotated[FiniteFloat, Field(ge=0)], ...]


_ARRAY: Final = TypeAdapter(_Float64MultiArray)


def read_posterior(message: dict[str, Any], heard_ns: int, topic: str = RESULTS_TOPIC) -> Posterior:
    """Return the posterior in a std_msgs/Float64MultiArray. If the array has no layout, the only label is `cell`.

    Raises:
        BadResultError: A value is not a probability, or the layout does not match the data.
    """
    array = validated(_ARRAY, message, topic, RESULTS_TYPE)
    values = array.data[array.layout.data_offset :]
    dimensions = array.layout.dim or (_Dimension(label="cell", size=len(values)),)
    sizes = tuple(dimension.size for dimension in dimensions)
    labels = tuple(dimension.label for dimension in dimensions)
    if math.prod(sizes) != len(values) or not values:
        raise BadResultError(
            f"a message on {topic} has {len(values)} values, but its layout says "
            f"{' x '.join(map(str, sizes))}: another program publishes there"
        )
    if len(set(labels)) != len(labels):
        raise BadResultError(f"a message on {topic} has two dimensions of the same name: {', '.join(labels)}")
    if not 0 < sum(values) < math.inf:
        raise BadResultError(f"the values in a message on {topic} do not have a positive, finite sum")
    return Posterior(probabilities=values, labels=labels, sizes=sizes, heard_ns=heard_ns)
