"""How a model becomes a deployment, beside the model itself: the options of thesis 3.2 and 3.4."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from toolchain.deployment import Queue, Stop

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from toolchain.deployment.sources import SourcesFile


class Scale(StrEnum):
    """What is divided by its maximum before quantising."""

    ADDRESS = "address"
    """Every address of a column by itself: the fewest cycles."""
    COLUMN = "column"
    """A column's whole table."""
    NONE = "none"
    """Nothing: the raw probabilities."""


class OnMissing(StrEnum):
    """What an absent reading is."""

    ERROR = "error"
    """An error: every frame has all readings."""
    MISSING = "missing"
    """A missing reading, which says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildOptions:
    """How a model becomes a deployment, beside the model itself."""

    uri: str
    """The rosbridge server on which readings come."""
    topic: str
    """The topic on which they come."""
    type: str
    """That topic's type."""
    output: str = "/BMresults"
    """The topic on which posteriors go out."""
    partitions: int = 1
    """How many boards the lines are split over."""
    interface: tuple[int, int] | None = None
    """Inputs and results of the boards' registers; None for the thesis's 20 x 1200, or the model's size
    where that is larger."""
    scale: Scale | None = None
    """What is divided by its maximum before quantising; None for addresses where a column shares one, else
    for whole columns."""
    prob_bits: int = 8
    """Bits of a code (W)."""
    prior_mode: PriorMode = PriorMode.TABLE
    """Whether the prior is the images' table, or written by the host."""
    prior_path: str | None = None
    """Where in the message a written prior is, one number for each line; None where it comes from elsewhere."""
    counter_bits: int = 8
    """Bits of a line's counter."""
    target_count: int | None = None
    """The count that stops a machine; None for the counters' largest."""
    max_cycles: int = 2**17
    """The cycles after which a machine stops anyway."""
    stop: Stop = Stop.SLICES
    """Whether boards stop together after slices, or each at its own overflow."""
    rng: RngKind = RngKind.LFSR32
    """Kind of the random number generators."""
    rng_table: NDArray[np.uint32] | None = None
    """uint32[length], the numbers that `rng = table` plays; None to make them."""
    shared: bool = True
    """One generator a column, shared by its lines; else one a cell."""
    steps_per_clock: int = 0
    """Steps of a generator between two cycles; 0 for as many as give fresh bits."""
    sensor_mode: SensorMode = SensorMode.COLUMN
    """What a cell is given: its column's reading, a reading of its own, or its code (`threshold`)."""
    replicas: int = 1
    """Machines on a board that share its generators."""
    rng_banks: int = 16
    """Sets of seeds."""
    rng_reset: RngReset = RngReset.BANK
    """Whether a frame restarts the generators."""
    queue: Queue = Queue.LATEST
    """What happens to frames that come faster than they are computed."""
    tolerance_s: float = 0.05
    """Within what time readings from several topics belong together, seconds."""
    sources: SourcesFile | None = None
    """Several topics and which variable comes from which, instead of `uri`, `topic` and `type`; or None."""
    build_date: str = ""
    """When it was built, ISO 8601; the images' manifests say it, their hashes don't cover it."""

    @property
    def scaling(self) -> Scale:
        """What is divided by its maximum: `scale`, or what goes without saying."""
        if self.scale is not None:
            return self.scale
        return Scale.ADDRESS if self.sensor_mode is SensorMode.COLUMN else Scale.COLUMN
