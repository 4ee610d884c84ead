"""The table of a sweep, with one row per machine and the Pareto front marked."""

from collections.abc import Sequence

from toolchain.analysis.exploration.results import Point


def table(points: Sequence[Point], front: Sequence[Point]) -> str:
    """Return the sweep as text; points on the Pareto front have a star.

    Sensor modes and replicas are columns only if some machines differ from the defaults.
    """
    keys = {point.key for point in front}
    several = any(point.replicas > 1 for point in points)
    modes = any(point.sensor_mode != "column" for point in points)
    rows = [
        "  "
        + ("cells      " if modes else "")
        + ("replicas  " if several else "")
        + "scale    rng     steps  codes  target  total variation (95 %)     by codes    KL bits  same MAP   z rms  without   cycles"
        "      95 %" + ("  a posterior" if several else "") + "     ALMs  blocks  fits"
    ]
    for point in sorted(points, key=lambda each: (each.cycles_a_posterior, each.total_variation or 1.0)):
        variation = (
            f"{point.total_variation:7.4f} ({point.total_variation_low:.4f}..{point.total_variation_high:.4f})"
            if point.total_variation is not None
            else "-"
        )
        rows.append(
            ("* " if point.key in keys else "  ")
            + (f"{point.sensor_mode:9}  " if modes else "")
            + (f"{point.replicas:8d}  " if several else "")
            + f"{point.scale:8} {point.rng:7} {point.steps_per_clock:5d}  {point.prob_bits:5d}  "
            f"{point.target_count:6d}  {variation:>24}  {_cell(point.quantising, '.4f'):>9}  {_cell(point.kl_bits, '.4f'):>9}  "
            f"{_cell(point.map_agreement, '.0%'):>8}  {_cell(point.z_rms, '.2f'):>6}  {point.without:7.1%}  "
            f"{point.cycles_median:7,.0f}  {point.cycles_95:8,.0f}  "
            + (f"{point.cycles_a_posterior:11,.1f}  " if several else "")
            + f"{_cell(point.alms, ',.0f'):>7}  {_cell(point.blocks, ','):>6}  "
            f"{'-' if point.fits is None else 'yes' if point.fits else 'no':>4}"
        )
    cycles = "cycles per posterior" if several else "cycles"
    rows.append(
        f"* no other machine is better in one of total variation, {cycles}, ALMs and frames without a posterior, and as good "
        "in the others"
    )
    return "\n".join(rows) + "\n"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
