"""The filter of a deployment: it predicts the prior of a frame from the posterior of the frame before.

    start ─▶ belief ──predict──▶ prediction ──codes──▶ written prior of the boards ──▶ posterior
                ▲                                                                          │
                └───────────────────────────────── update ─────────────────────────────────┘

If a frame has no posterior, the prediction becomes the belief.
"""

import hashlib
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.encode import encode_probability
from toolchain.bounded_files import read_bounded
from toolchain.errors import DamagedDeploymentError, DeploymentError, ModelError

_SUM_TOLERANCE: Final = 1e-6
_MOST_WORK: Final = 2**27
"""Maximum number of multiplications in one prediction; that many take about 0.2 s."""
_HEADER_BYTES: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """P(S) before the first frame, and the change of S from frame to frame.

    Raises a ModelError if a distribution has a negative number or does not sum to 1, or if the shapes do not match.
    """

    start: NDArray[np.float64]
    """P(S) before the first frame, float64[lines]."""
    table: NDArray[np.float64]
    """P(S | S one frame earlier), float64[lines, lines]. Each row belongs to one value of the earlier S."""

    def __post_init__(self) -> None:
        lines = np.shape(self.start)
        if len(lines) != 1 or not lines[0] or np.shape(self.table) != lines * 2:
            raise ModelError(
                f"the transition has shape {np.shape(self.table)} and its start {np.shape(self.start)}, expected (lines, "
                "lines) and (lines,)"
            )
        for name, rows in (("start", self.start), ("table", self.table)):
            own = np.array(rows, np.float64)
            if not (own >= 0).all() or not (abs(own.sum(axis=-1) - 1) <= _SUM_TOLERANCE).all():
                raise ModelError(
                    f"the {name} of the transition has a negative number, or a distribution that does not sum to 1"
                )
            object.__setattr__(self, name, own)

    def after(self, belief: NDArray[np.float64], steps: int = 1) -> NDArray[np.float64]:
        """Return P(S) `steps` frames after `belief`, if no readings arrive in between: float64[lines]."""
        for _ in range(steps):
            belief = belief @ self.table
        later: NDArray[np.float64] = belief / belief.sum()
        return later

    def content(self) -> bytes:
        """Return the bytes of the filter's .npy file: float64[1 + lines, lines], `start` above the rows of `table`."""
        return (
            _header((len(self.table) + 1, len(self.table)))
            + np.vstack([self.start, self.table]).astype("<f8").tobytes()
        )

    @classmethod
    def read(cls, path: Path, lines: int, sha256: str) -> "Transition":
        """Read the file of a filter. Raise a DeploymentError if the file is missing, damaged or of another build."""
        if not path.is_file():
            raise DamagedDeploymentError(
                f"{path}, the filter's start and transition, does not exist: build it again with 'toolchain build'"
            )
        data = read_bounded(path, 8 * (lines + 1) * lines + _HEADER_BYTES, DeploymentError)
        if (found := hashlib.sha256(data).hexdigest()) != sha256:
            raise DamagedDeploymentError(
                f"{path} is of another build, or damaged: its hash is {found[:16]}, deployment.toml names {sha256[:16]}"
            )
        shape = (lines + 1, lines)
        header = _header(shape)
        why = f"it does not have its {len(header) + 8 * math.prod(shape)} bytes, or another header"
        if data.startswith(header) and len(data) == len(header) + 8 * math.prod(shape):
            rows = np.frombuffer(data, "<f8", offset=len(header)).reshape(shape)
            try:
                return cls(rows[0], rows[1:])
            except ModelError as reason:
                why = str(reason)
        raise DamagedDeploymentError(
            f"{path} is not float64{list(shape)}, the filter's start and transition: {why}"
        )


def _header(shape: tuple[int, int]) -> bytes:
    """Return the NumPy header that the file must have.

    The file's own header is compared and not parsed, because a hostile header breaks NumPy's parser.
    """
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue()


def prediction_codes(prediction: NDArray[np.float64], prob_bits: int) -> NDArray[np.uint16]:
    """Return the codes of a predicted prior, uint16[lines], relative to its maximum.

    A line with a prediction above 0 gets at least code 1. With code 0, its posterior would be 0 for all readings, even
    if the searched variable has changed to the line's value.
    """
    codes = encode_probability(prediction / prediction.max(), prob_bits)
    codes[(codes == 0) & (prediction > 0)] = 1
    return codes


class Filter:
    """A running filter. It keeps the belief about the searched variable from frame to frame."""

    def __init__(self, transition: Transition, prob_bits: int) -> None:
        """Begin with the start distribution of `transition`. `prob_bits` is the width of the codes."""
        self.transition: Final = transition
        self._prob_bits = prob_bits
        self.most_steps: Final = max(1, _MOST_WORK // transition.table.size)
        """Maximum number of frames by which one prediction moves the belief, even after a longer gap."""
        self.belief: NDArray[np.float64] = transition.start
        """P(S | all readings so far), float64[lines]; after `predict`, P(S) of the next frame before its readings."""

    def predict(self, steps: int = 1) -> NDArray[np.uint16]:
        """Advance the belief by `steps` frames, and return it as the codes of a prior: uint16[lines].

        If `steps` is larger than `most_steps`, the belief advances by `most_steps` frames.
        """
        self.belief = self.transition.after(self.belief, min(steps, self.most_steps))
        return prediction_codes(self.belief, self._prob_bits)

    def update(self, posterior: NDArray[np.float64] | None) -> None:
        """Set the belief to the posterior of the frame. If `posterior` is None, keep the prediction as the belief."""
        if posterior is not None:
            self.belief = posterior
