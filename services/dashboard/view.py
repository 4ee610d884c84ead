"""The view of one browser: messages for the page with the newest or an earlier frame and its marginals.

A message is binary. It contains the length of the head (4 bytes, little-endian), the head (JSON), and the picture.
A heat map has a byte for each cell, relative to the highest cell. A bar is a little-endian float32. After the bars
of a BM2, the sampling errors of the bars follow as little-endian float32.
"""

import struct
import time
from collections.abc import Mapping, Sequence
from decimal import Decimal
from functools import lru_cache
from itertools import combinations
from typing import Any, Final

import numpy as np
import orjson

from posteriors.axes import Axis
from posteriors.frame_report import FrameReport
from posteriors.standard_messages import moments
from services.dashboard.feed import Feed, KeptFrame

_LENGTH: Final = struct.Struct("<I")
_NO_REPORT: Final = FrameReport(stamp_ns=0, outcome="posterior without a report")
_MAX_CHOICES: Final = 200
_LARGEST: Final = 1 << 53
_ACROSS: Final = "x"
"""Label of the variable that is always drawn from left to right, as on a map."""


class View:
    """The choices of one browser.

    Attributes:
        at: Number of the frame that is shown (`KeptFrame.at`), or None to show the newest frame.
        chosen: Labels of the one or two variables whose marginal is shown. If it is empty, the default is shown.
    """

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self.at: int | None = None
        self.chosen: tuple[str, ...] = ()

    @property
    def frame(self) -> KeptFrame | None:
        """The frame that is shown, or None before the first frame."""
        return self._feed.newest if self.at is None else self._feed.frame(self.at)

    def pause(self, paused: bool) -> None:
        """If `paused`, stay at the frame that is shown, otherwise return to the newest."""
        frame = self.frame
        self.at = frame.at if paused and frame is not None else None
        self._feed.changed()

    def step(self, frames: int) -> None:
        """Pause, and move forward by `frames`, or back if negative, as far as frames are kept."""
        if (frame := self.frame) is not None:
            found = self._feed.frame(frame.at + frames)
            self.at = found.at if found is not None else None
        self._feed.changed()

    def choose(self, labels: tuple[str, ...]) -> None:
        """Show the marginal of these labels."""
        self.chosen = labels
        self._feed.changed()

    def labels(self, frame: KeptFrame) -> tuple[str, ...]:
        """Return the labels of the marginal to show for a frame. Of two labels, the first is the vertical axis."""
        if self.chosen and set(self.chosen) <= set(frame.labels):
            return self.chosen
        return default_labels(frame)

    def message(
        self, frame: KeptFrame, axes: Sequence[Axis], words: Mapping[str, tuple[str, tuple[str, ...]]]
    ) -> bytes:
        """Return the message for a frame to show. `words` maps a known variable's name to its unit and its states."""
        head, picture = _encoded(frame, self.labels(frame), tuple(axes))
        kept = self._feed.frames
        now_ns = time.time_ns()
        head = head | {
            "readings": [
                _in_words(reading, *words.get(reading[0], ("", ()))) for reading in head["readings"]
            ],
            "paused": self.at is not None,
            "first": kept[0].at,
            "last": kept[-1].at,
            "sent_ms": now_ns / 1e6,
            "age_ms": max(now_ns - frame.heard_ns, 0) / 1e6,
        }
        return packed(head, picture)


def _in_words(reading: list[Any], unit: str, states: tuple[str, ...]) -> list[Any]:
    name, value, address, age_ms = reading
    if isinstance(address, int) and 0 <= address < len(states):
        value = states[address]
    return [name, value, address, age_ms, unit]


def packed(head: dict[str, Any], picture: bytes = b"") -> bytes:
    """Return a message with this head and picture."""
    # NaN would be no JSON; orjson writes null
    text = orjson.dumps(head, option=orjson.OPT_SERIALIZE_NUMPY)
    return b"".join((_LENGTH.pack(len(text)), text, picture))


def default_labels(frame: KeptFrame) -> tuple[str, ...]:
    """Return the variables to draw by default: the first two searched variables, or the only searched variable.

    The second variable is drawn horizontally. If one of the two is `x`, it is the second.
    """
    first = frame.searched[:2]
    return first[::-1] if first[:1] == (_ACROSS,) and len(first) == 2 else first


def choices(labels: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the marginals that a user can choose, each as its labels: pairs first, then single variables."""
    pairs: list[tuple[str, ...]] = [
        pair[::-1] if pair[0] == _ACROSS else pair for pair in combinations(labels, 2)
    ]
    return [*pairs, *((label,) for label in labels)][:_MAX_CHOICES]


# Several browsers show the same frame, so that it is encoded once. Frames are compared by identity.
@lru_cache(maxsize=4)
def _encoded(
    frame: KeptFrame, labels: tuple[str, ...], axes: tuple[Axis, ...]
) -> tuple[dict[str, Any], bytes]:
    report = frame.report or _NO_REPORT
    head: dict[str, Any] = {
        "kind": "frame",
        "at": frame.at,
        "heard_ms": frame.heard_ns / 1e6,
        "number": _shown(report.number),
        "outcome": report.outcome,
        "cycles": _shown(report.cycles),
        "boards": [[each.name, each.stopped, _shown(each.cycles)] for each in report.boards],
        "readings": [
            [name, one.value, _shown(one.address), one.age_ms] for name, one in report.readings.items()
        ],
        "missing": report.missing,
        "statistics": frame.statistics,
        "truth": frame.truth,
        "plot": None,
    }
    if frame.values is None or not labels:
        return head, b""
    marginal = frame.marginal(labels)
    shown = [_axis(label, size, axes) for label, size in zip(labels, marginal.shape, strict=True)]
    peak = float(marginal.max())
    errors = frame.sampling_error(marginal)
    worst = None if errors is None else float(errors.max())
    head["plot"] = plot = {"axes": shown, "max": peak, "error": worst}
    if marginal.ndim == 1:
        bars = marginal if errors is None else np.concatenate([marginal, errors])
        return head, bars.astype("<f4").tobytes()
    # names have no mean
    if not any(axis["states"] for axis in shown):
        plot["mean"], plot["covariance"] = moments(marginal)
    return head, np.rint(marginal * (255 / peak)).astype(np.uint8).tobytes()


def _shown(number: int | None) -> int | str | None:
    # anybody can publish larger numbers than JSON's readers and floats know
    return number if number is None or abs(number) < _LARGEST else f"{Decimal(number):.3g}"


def _axis(label: str, size: int, axes: tuple[Axis, ...]) -> dict[str, Any]:
    """Return an axis for the page. Without a deployment, the values of the axis are the cells' indices."""
    known = next((axis.dimension for axis in axes if axis.label == label and axis.dimension), None)
    return {
        "label": label,
        "size": size,
        "known": known is not None,
        "unit": known.unit if known else "",
        "offset": known.offset if known else 0.0,
        "step": known.step if known else 1.0,
        "states": list(known.states) if known else [],
    }
