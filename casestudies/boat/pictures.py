"""Pictures of posteriors next to true positions (thesis figure 4.4), and of a frame's time by stage (figure 4.5)."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from statistics import fmean
from types import MappingProxyType
from typing import Any, Final, TypeAlias

from casestudies.boat.sensors import BEACONS, map_grid
from casestudies.grid import Grid
from casestudies.topics import Instance, Truth
from posteriors.posterior import Posterior
from terminal.errors import OutputError
from terminal.pictures import new_figure, save_figure


class StageKind(StrEnum):
    """Kinds of stages in which a frame spends time. The thesis reports a share for each kind except `HOST`."""

    ROSBRIDGE = "rosbridge"
    HOST = "between the host's processes"
    REGISTERS = "link to the boards"
    COMPUTING = "computing on the boards"


THESIS_SHARES: Final = {StageKind.ROSBRIDGE: 0.9874, StageKind.COMPUTING: 0.0124, StageKind.REGISTERS: 0.0001}
"""Shares of a frame's time for each kind of stage, as in the thesis (4.3)."""
PCIE: Final = "pcie-gen2"


@dataclass(frozen=True, slots=True, kw_only=True)
class StageShare:
    """A stage of a frame: its mean time over the frames that report it, and its share of the sum over all stages."""

    name: str
    part: StageKind
    mean_us: float
    share: float


def _reported(field: str) -> Callable[[Instance], float | None]:
    return lambda instance: getattr(instance.report.stages, field) if instance.report else None


def _of_computing(instance: Instance) -> tuple[float | None, float | None]:
    """Split the wait for the boards into computing time and link time, in us. Both are None if the wait is unknown."""
    if instance.report is None or (waited := instance.report.stages.compute) is None:
        return None, None
    own = instance.report.stages.boards_compute
    return (waited, 0.0) if own is None else (own, max(0.0, waited - own))


_Stage: TypeAlias = "tuple[str, StageKind, Callable[[Instance], float | None]]"
"""A stage's name, its kind, and a function that returns its microseconds in a frame (None if not known)."""

_STAGES: Final[tuple[_Stage, ...]] = (
    ("rosbridge in", StageKind.ROSBRIDGE, _reported("rosbridge_in")),
    ("local hops", StageKind.HOST, _reported("local_hops")),
    ("register writes", StageKind.REGISTERS, _reported("register_writes")),
    ("computing", StageKind.COMPUTING, lambda instance: _of_computing(instance)[0]),
    ("start and answer", StageKind.REGISTERS, lambda instance: _of_computing(instance)[1]),
    ("register reads", StageKind.REGISTERS, _reported("reads")),
    (
        "rosbridge out",
        StageKind.ROSBRIDGE,
        lambda instance: instance.posterior.rosbridge_out_us if instance.posterior else None,
    ),
)


def stage_shares(instances: Iterable[Instance]) -> tuple[StageShare, ...]:
    """Return the stages in order, with their mean times over the frames that have a posterior.

    A stage is left out if its time is unknown in all frames with a posterior. The stage `rosbridge out` lasts from the
    sending of a posterior until the posterior arrives in this process. The times of all other stages come from
    `/bm/frame`.
    """
    return _shares(instances, _STAGES)


def projected_shares(instances: Iterable[Instance], clock_hz: float) -> tuple[StageShare, ...]:
    """Return the stages as projected for real boards, or () if the frames do not report cycles and bytes.

    The computing time is the number of cycles that the boards counted, divided by `clock_hz`. A model of PCIe gives
    the time of the link for the bytes transferred. The times of host and rosbridge are measured.
    """
    stages = (
        _STAGES[0],
        _STAGES[1],
        ("PCIe reads and writes", StageKind.REGISTERS, _link_us(PCIE)),
        (f"BM1 at {clock_hz / 1e6:g} MHz", StageKind.COMPUTING, _compute_us(clock_hz)),
        _STAGES[-1],
    )
    shares = _shares(instances, stages)
    return shares if len(shares) == len(stages) else ()


def mean_link_us(instances: Iterable[Instance], rate: str) -> float:
    """Return a frame's mean transfer time in us at the link rate `rate`, or 0 if the frames do not report transfers."""
    return sum(share.mean_us for share in _shares(instances, (("", StageKind.REGISTERS, _link_us(rate)),)))


def _link_us(rate: str) -> Callable[[Instance], float | None]:
    return lambda instance: instance.report.link_us(rate) if instance.report else None


def _compute_us(clock_hz: float) -> Callable[[Instance], float | None]:
    def time_of(instance: Instance) -> float | None:
        cycles = instance.report.cycles if instance.report else None
        return None if cycles is None else 1e6 * cycles / clock_hz

    return time_of


def _shares(instances: Iterable[Instance], stages: Iterable[_Stage]) -> tuple[StageShare, ...]:
    published = [instance for instance in instances if instance.posterior is not None]
    means: list[tuple[str, StageKind, float]] = []
    for name, part, time_of in stages:
        known = [time for time in map(time_of, published) if time is not None]
        if known:
            means.append((name, part, fmean(known)))
    total = sum(mean for _, _, mean in means)
    return tuple(
        StageShare(name=name, part=part, mean_us=mean, share=mean / total if total else 0.0)
        for name, part, mean in means
    )


POSITIONS_SHOWN: Final = 4
"""Number of positions in figure 4.4, as in the thesis."""

_PART_COLOURS: Final = {
    StageKind.ROSBRIDGE: "#4477aa",
    StageKind.HOST: "#bbbbbb",
    StageKind.REGISTERS: "#ccbb44",
    StageKind.COMPUTING: "#ee6677",
}
_TRUTH_COLOUR: Final = "#ff4d4d"
_EDGE: Final = 0.2
"""Width of the strips at the map's left and right edges where labels are not centred, as a share of its width."""


def far_apart(instances: Iterable[Instance]) -> tuple[Instance, ...]:
    """Return at most `POSITIONS_SHOWN` results with true positions far from each other, in the order of time.

    The function chooses the first result. It then repeatedly adds the result whose nearest chosen result is furthest
    away. Results without a true position count only if no result has one.
    """
    results = [instance for instance in instances if instance.posterior is not None]
    candidates = [instance for instance in results if instance.truth is not None] or results
    kept: list[int] = []
    while len(kept) < min(POSITIONS_SHOWN, len(candidates)):
        free = [i for i in range(len(candidates)) if i not in kept]
        kept.append(max(free, key=lambda i: min((_apart(candidates, i, j) for j in kept), default=0.0)))
    return tuple(candidates[i] for i in sorted(kept))


def draw_positions(path: Path, instances: Sequence[Instance], *, route: Sequence[Truth] = ()) -> None:
    """Draw figure 4.4 of the thesis.

    For each instance, the figure shows the true position on the map. The posterior over x and y is next to the map.
    The true positions of the whole route are drawn faintly.

    Raises:
        OutputError: A posterior is not two-dimensional, or the file cannot be written.
    """
    across = 2 if len(instances) > 1 else 1
    down = math.ceil(len(instances) / across)
    figure = new_figure(5.6 * across + 0.9, 2.95 * down + 0.75)
    axes = figure.subplots(down, 2 * across, squeeze=False)
    scale = max(_posterior_of(instance).probability for instance in instances)
    image = None
    for number, instance in enumerate(instances):
        row, pair = divmod(number, across)
        grid = posterior_grid(_posterior_of(instance))
        _draw_map(axes[row, 2 * pair], grid, instance, route, number)
        image = _draw_posterior(axes[row, 2 * pair + 1], grid, instance, scale, number)
    for blank in axes.flat[2 * len(instances) :]:
        blank.set_axis_off()
    if image is not None:
        figure.colorbar(image, ax=list(axes.flat), label="probability of a cell", shrink=0.8, pad=0.01)
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, handletextpad=0.4
    )
    between = " " if across > 1 else "\n"
    figure.suptitle(
        f"The boat's position (a){between}and the Bayesian machine's posterior given its readings (b)"
    )
    save_figure(figure, path)


def draw_shares(
    path: Path,
    shares: Sequence[StageShare],
    *,
    frames: int,
    title: str = "Time of a frame by stage",
    note: str = "",
    beside: Mapping[StageKind, float] = MappingProxyType({}),
) -> None:
    """Draw figure 4.5: the mean time of each stage, and its share of a frame's time.

    `note` is appended to the label of the time axis. The legend shows the share of each kind of stage. If `beside` has
    the thesis's share of a kind, the legend shows that share too. Raises an OutputError if the file cannot be written.
    """
    figure = new_figure(8.4, 1.5 + 0.42 * max(len(shares), 1))
    axes = figure.subplots()
    names = [stage.name for stage in shares]
    times = [stage.mean_us / 1000 for stage in shares]
    bars = axes.barh(names, times, color=[_PART_COLOURS[stage.part] for stage in shares], height=0.72)
    axes.bar_label(
        bars,
        [f"{time:.3f} ms   {100 * stage.share:.1f} %" for time, stage in zip(times, shares, strict=True)],
        padding=4,
    )
    axes.invert_yaxis()
    axes.set_xlim(0, 1.32 * max(times, default=1.0))
    axes.set_xlabel(f"mean time a frame, in ms{note}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    parts = [part for part in StageKind if any(stage.part is part for stage in shares)]
    figure.legend(
        [axes.barh([0], [0], color=_PART_COLOURS[part]) for part in parts],
        [
            f"{part}: {100 * sum(stage.share for stage in shares if stage.part is part):.1f} %"
            + (f" (thesis {100 * beside[part]:.2f} %)" if part in beside else "")
            for part in parts
        ],
        loc="outside lower center",
        ncols=2,
        frameon=False,
    )
    axes.set_title(f"{title}: {sum(times):.2f} ms, mean of {frames} frames")
    save_figure(figure, path)


def posterior_grid(posterior: Posterior) -> Grid:
    """Return the map divided into the posterior's cells. Raises an OutputError if the posterior is not over a map."""
    if len(posterior.sizes) != 2:
        raise OutputError(
            f"the boat's posterior has two dimensions, y and x, but the one received has "
            f"{' x '.join(map(str, posterior.sizes))} values: is this the boat's deployment?"
        )
    height, width = posterior.sizes
    return map_grid(width, height)


def _draw_map(axes: Any, grid: Grid, instance: Instance, route: Sequence[Truth], number: int) -> None:
    _map_axes(axes, grid, f"({number + 1}a) true position")
    axes.set_facecolor("#eaf2f8")
    _draw_beacons(axes)
    axes.plot([t.x for t in route], [t.y for t in route], color="#9fb8cc", linewidth=0.8, zorder=1)
    truth = instance.truth
    if truth is None:
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", va="center", color="0.4")
        return
    for x, y in BEACONS:
        axes.plot([x, truth.x], [y, truth.y], color="0.45", linewidth=0.7, linestyle=(0, (4, 3)), zorder=2)
    axes.scatter(
        [truth.x],
        [truth.y],
        marker="o",
        s=64,
        color=_TRUTH_COLOUR,
        edgecolors="black",
        clip_on=False,
        zorder=4,
    )
    across = (truth.x - grid.x_low) / (grid.x_high - grid.x_low)
    axes.annotate(
        f"({truth.x:.1f}, {truth.y:.1f})",
        (truth.x, truth.y),
        xytext=(0, 9 if truth.y < 30 else -17),
        textcoords="offset points",
        # near the map's edge it would cover the axis
        ha="left" if across < _EDGE else "right" if across > 1 - _EDGE else "center",
        fontsize=8,
        zorder=3.5,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )


def _draw_posterior(axes: Any, grid: Grid, instance: Instance, scale: float, number: int) -> Any:
    from matplotlib.patheffects import withStroke

    posterior = _posterior_of(instance)
    height, width = posterior.sizes
    title = f"({number + 1}b) posterior"
    if instance.report is not None and instance.report.number is not None:
        title += f", frame {instance.report.number}"
    _map_axes(axes, grid, title)
    rows = [posterior.probabilities[row * width : (row + 1) * width] for row in range(height)]
    image = axes.imshow(
        rows,
        origin="lower",
        extent=(grid.x_low, grid.x_high, grid.y_low, grid.y_high),
        cmap="viridis",
        vmin=0.0,
        vmax=scale,
        interpolation="nearest",
    )
    if instance.truth is not None:
        axes.scatter(
            [instance.truth.x],
            [instance.truth.y],
            marker="o",
            s=90,
            facecolors="none",
            edgecolors=_TRUTH_COLOUR,
            linewidths=1.8,
            clip_on=False,
            zorder=4,
            label="true position",
        )
    mean_x, mean_y = grid.mean(posterior.probabilities)
    outline = [withStroke(linewidth=3.2, foreground="black")]
    axes.plot(
        [mean_x],
        [mean_y],
        marker="+",
        markersize=10,
        markeredgewidth=1.5,
        color="white",
        linestyle="none",
        path_effects=outline,
        zorder=4,
        label="posterior's mean",
    )
    _draw_beacons(axes)
    return image


def _map_axes(axes: Any, grid: Grid, title: str) -> None:
    axes.set_xlim(grid.x_low, grid.x_high)
    axes.set_ylim(grid.y_low, grid.y_high)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("x (map units)", fontsize=8)
    axes.set_ylabel("y (map units)", fontsize=8)
    axes.set_xticks([grid.x_low, (grid.x_low + grid.x_high) / 2, grid.x_high])
    axes.set_yticks([grid.y_low, (grid.y_low + grid.y_high) / 2, grid.y_high])
    axes.tick_params(labelsize=8)


def _draw_beacons(axes: Any) -> None:
    xs, ys = zip(*BEACONS, strict=True)
    axes.scatter(
        xs, ys, marker="^", s=46, color="#ffd24d", edgecolors="black", zorder=5, clip_on=False, label="beacon"
    )


def _posterior_of(instance: Instance) -> Posterior:
    if instance.posterior is None:
        raise OutputError("a frame without a posterior cannot be drawn")
    return instance.posterior


def _apart(instances: Sequence[Instance], one: int, other: int) -> float:
    a, b = instances[one].truth, instances[other].truth
    if a is None or b is None:
        return float(abs(one - other))
    return math.dist((a.x, a.y), (b.x, b.y))
