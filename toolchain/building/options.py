"""The options of a build: everything except the model (thesis 3.2, 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from pydantic import ValidationError

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from toolchain.deployment import Output, Queue, Scale, Source, Stop, WrittenPrior
from toolchain.errors import BuildError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from toolchain.building.sources_file import SourcesFile


_FLAGS: Final = {"tolerance_s": "--tolerance", "path": "--prior-path"}
"""Flags with other names than their fields."""


class OnMissing(StrEnum):
    """The meaning of an absent reading."""

    ERROR = "error"
    """An error: every frame has all readings."""
    MISSING = "missing"
    """A missing reading, which leaves the posterior as it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildOptions:
    """The options of a build."""

    uri: str
    """The rosbridge server of the readings."""
    topic: str
    """The topic of the readings."""
    type: str
    """That topic's type."""
    output: str = "/BMresults"
    """The topic of the posteriors."""
    partitions: int = 1
    """The number of boards."""
    interface: tuple[int, int] | None = None
    """Inputs and results of the boards' registers; None for the thesis's 20 x 1200, or the size of the model
    if larger.
    """
    scale: Scale | None = None
    """The part of a table that is divided by its maximum before quantising; None for addresses if the lines
    of a column share them, otherwise for whole columns.
    """
    prob_bits: int = 8
    """Bits of a code (W)."""
    prior_mode: PriorMode = PriorMode.TABLE
    """Source of the prior: a table in the images, or the host."""
    prior_path: str | None = None
    """The path of a written prior in the message, with one number per line; None if it comes from elsewhere.
    """
    counter_bits: int = 8
    """Bits of a line's counter."""
    target_count: int | None = None
    """The count that stops a machine; None for the maximum of the counters."""
    max_cycles: int = 2**17
    """Maximum number of cycles."""
    stop: Stop = Stop.SLICES
    """Stop rule: all boards together after a slice, or each at its own overflow."""
    rng: RngKind = RngKind.LFSR32
    """Kind of the random number generators."""
    rng_table: NDArray[np.uint32] | None = None
    """uint32[length], the random numbers for `rng = table`; None to generate them."""
    shared: bool = True
    """One generator per column, shared by its lines; otherwise one per cell."""
    steps_per_clock: int = 0
    """Steps of a generator per cycle; 0 for as many as are needed for fresh bits."""
    sensor_mode: SensorMode = SensorMode.COLUMN
    """The input of a cell: the reading of its column, its own reading, or its own code (`threshold`)."""
    replicas: int = 1
    """Number of machines on a board, which share the generators."""
    rng_banks: int = 16
    """Number of seed sets."""
    rng_reset: RngReset = RngReset.BANK
    """Reset rule of the generators: whether each frame restarts them."""
    queue: Queue = Queue.LATEST
    """The readings that wait if they arrive faster than frames are computed."""
    tolerance_s: float = 0.05
    """Maximum time in seconds between readings of several topics that belong together."""
    sources: SourcesFile | None = None
    """Several topics and their variables, in place of `uri`, `topic` and `type`; or None."""
    build_date: str = ""
    """The date of the build, ISO 8601: part of the images' manifests, but not of their hashes."""

    def __post_init__(self) -> None:
        """Refuse a server, topic, type or path that is none, before a model is read."""
        try:
            Output(topic=self.output), self.all_sources, self.written_prior
        except ValidationError as reason:
            raise refused_option(reason) from None

    @property
    def scaling(self) -> Scale:
        """The part of a table that is divided by its maximum: `scale`, or its default."""
        if self.scale is not None:
            return self.scale
        return Scale.ADDRESS if self.sensor_mode is SensorMode.COLUMN else Scale.COLUMN

    @property
    def all_sources(self) -> tuple[Source, ...]:
        """The sources of readings, as in a deployment."""
        if self.sources is not None:
            return self.sources.sources
        return (Source(uri=self.uri, topic=self.topic, type=self.type),)

    @property
    def written_prior(self) -> WrittenPrior | None:
        """The source of a written prior, or None."""
        if self.sources is not None:
            return self.sources.prior
        return None if self.prior_path is None else WrittenPrior(path=self.prior_path)


def refused_option(reason: ValidationError) -> BuildError:
    """Return a pydantic error as an error with the flag of the field."""
    detail = reason.errors(include_url=False)[0]
    key = str(detail["loc"][0]) if detail["loc"] else ""
    flag = "--output" if reason.title == "Output" else _FLAGS.get(key, "--" + key.replace("_", "-"))
    if detail["type"] == "value_error":
        sentence = str(detail["ctx"]["error"])
        return BuildError(f"{flag}: {sentence}" if key else sentence)
    return BuildError(
        f"{flag} is {detail['input']!r}, expected {detail['msg'].removeprefix('Input should be ')}"
    )
