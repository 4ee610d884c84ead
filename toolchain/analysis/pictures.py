"""Pictures of sweeps and claims; matplotlib is imported only when one is drawn."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from toolchain.analysis.claims import Claims
from toolchain.analysis.results import Point
from toolchain.errors import BuildError

_DPI: Final = 75
_COLOURS: Final = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
_MARKERS: Final = "osD^v<>P"
_SUFFIXES: Final = (".png", ".svg", ".pdf")
_KINDS_INSIDE: Final = 5
"""Maximum length of a legend inside the picture, where a longer one would cover points."""


def check_pictures_possible(path: Path | None = None) -> None:
    """Raise a BuildError, before a long run, for a picture that cannot be drawn or written."""
    if find_spec("matplotlib") is None:
        raise BuildError(
            "a plot needs matplotlib, which is not installed: run pip install matplotlib, or omit --plot"
        )
    if path is None:
        return
    if path.suffix not in _SUFFIXES:
        raise BuildError(
            f"{path} is not the name of a picture; expected a name that ends in {', '.join(_SUFFIXES)}"
        )
    there = path.exists()
    try:
        with path.open("ab"):
            pass
        if not there:
            path.unlink()
    except OSError as reason:
        raise BuildError(
            f"{path} cannot be written: {reason.strerror or reason}; name another file"
        ) from None


def draw_sweep(path: Path, name: str, points: Sequence[Point], front: Sequence[Point]) -> None:
    """Draw accuracy against cycles, with ALMs as the size of points, and the Pareto front."""
    shown = [point for point in points if point.total_variation is not None]
    largest = max((point.alms or 0.0 for point in shown), default=0.0) or 1.0
    several = any(point.replicas > 1 for point in points)
    kinds = sorted({_kind(point) for point in shown})
    beside = len(kinds) > _KINDS_INSIDE
    figure = _figure((10.2 if beside else 7.2, 4.8))
    axes = figure.subplots()
    for at, kind in enumerate(kinds):
        of_kind = [point for point in shown if _kind(point) == kind]
        axes.scatter(
            [point.cycles_a_posterior for point in of_kind],
            [point.total_variation for point in of_kind],
            s=[20 + 120 * (point.alms or 0.0) / largest for point in of_kind],
            color=_COLOURS[at % len(_COLOURS)],
            marker=_MARKERS[at % len(_MARKERS)],
            alpha=0.6,
            label=_label(kind),
        )
    axes.scatter(
        [point.cycles_a_posterior for point in front],
        [point.total_variation for point in front],
        s=220,
        facecolors="none",
        edgecolors="black",
        linewidths=0.8,
        label="Pareto front",
    )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="cycles of a frame (median)" if not several else "cycles of a frame / its posteriors (median)",
        ylabel="total variation to exact inference (mean)",
        title=f"{name}: accuracy against cycles; the larger, the more ALMs",
    )
    axes.grid(alpha=0.3, which="both")
    if beside:
        figure.legend(loc="outside right center", fontsize="small", frameon=False)
    else:
        axes.legend(fontsize="small", frameon=False)
    _save(figure, path)


def _kind(point: Point) -> tuple[str, int, str, str]:
    return point.sensor_mode, point.replicas, point.scale, point.rng


def _label(kind: tuple[str, int, str, str]) -> str:
    mode, replicas, scale, rng = kind
    others = ("" if mode == "column" else f", {mode}") + ("" if replicas == 1 else f", {replicas} replicas")
    return f"{rng}, scale {scale}{others}"


def draw_claims(path: Path, claims: Claims) -> None:
    """Draw the thesis's claims, one panel each."""
    figure = _figure((11.0, 7.4))
    panels = figure.subplots(2, 2)
    for axes, series, title, label in (
        (panels[0, 0], claims.lines, "(a) lines: cycles do not depend on them (2.1.2)", "lines"),
        (panels[0, 1], claims.sensors, "(b) sensors: cycles grow with them (2.1.2, 4.3)", "sensors"),
        (panels[1, 0], claims.targets, "(c) counters: cycles grow with their size (2.1.2)", "target count"),
    ):
        axes.plot([each.x for each in series], [each.median for each in series], "o-", color=_COLOURS[0])
        axes.fill_between(
            [each.x for each in series],
            [each.low for each in series],
            [each.high for each in series],
            color=_COLOURS[0],
            alpha=0.2,
            linewidth=0,
        )
        scale = "linear" if label == "sensors" else "log"
        axes.set(xscale=scale, yscale="log", xlabel=label, ylabel="cycles (median, quartiles)", title=title)
        axes.grid(alpha=0.3, which="both")
    low, high = panels[0, 0].get_ylim()
    panels[0, 0].set_ylim(low / 3, high * 3)
    axes = panels[1, 1]
    for at, (name, faults) in enumerate(claims.faults.items()):
        axes.errorbar(
            [each.rate or claims.lowest_rate / 3 for each in faults],
            [each.total_variation for each in faults],
            yerr=[
                [each.total_variation - each.low for each in faults],
                [each.high - each.total_variation for each in faults],
            ],
            marker=_MARKERS[at],
            markersize=4,
            color=_COLOURS[at],
            linewidth=1.2,
            capsize=2,
            label=name,
        )
    axes.set(
        xscale="log",
        xlabel=f"share of bits that are flipped (leftmost: none, drawn at {claims.lowest_rate / 3:.0e})",
        ylabel="total variation (mean, 95 %)",
        title="(d) flipped bits (2.1.1)",
        ylim=(0, 1.02),
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", frameon=False)
    _save(figure, path)


def _figure(size: tuple[float, float]) -> Any:
    check_pictures_possible()
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _save(figure: Any, path: Path) -> None:
    """Write a picture without matplotlib's version, so that the file changes only with the drawing."""
    try:
        figure.savefig(path, dpi=_DPI, metadata={"Software": None} if path.suffix == ".png" else None)
    except (OSError, ValueError) as reason:
        raise BuildError(f"{path} cannot be written: {getattr(reason, 'strerror', None) or reason}") from None
