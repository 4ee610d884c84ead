"""Coordinate transforms between the frames of a robot: a tree of frames over time, without any connection.

Conventions are those of tf2 (http://wiki.ros.org/tf2): quaternions are (x, y, z, w), and the transform from frame
`source` to frame `target` maps the coordinates of a point in `source` to those in `target`.
"""

from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bridge.errors import ExtrapolationError, FramesUnconnectedError, FrameUnknownError
from bridge.stamps import stamp_ns

HISTORY_S: Final = 10.0
"""Seconds for which the transforms of a frame are stored."""
MAX_ENTRIES: Final = 10_000
"""Maximum number of stored transforms of a frame; then the oldest is dropped."""
MAX_FRAMES: Final = 10_000
"""Maximum number of frames; further ones are ignored."""
MAX_TRANSFORMS: Final = 250_000
"""Maximum number of stored transforms of all frames, about 100 MB; then the older half of each frame is dropped."""
MAX_NAME: Final = 1000
"""Maximum length of a frame's name; longer ones are ignored."""
LARGEST: Final = 1e100
"""Maximum absolute value of a coordinate, so that chains of transforms do not overflow; larger ones are unusable."""
_NEARLY_PARALLEL: Final = 0.9995

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A rotation followed by a translation, and the time for which it is valid.

    Attributes:
        translation: Metres, of shape (3,).
        rotation: Unit quaternion (x, y, z, w), of shape (4,).
        stamp_ns: Nanoseconds since 1970; 0 for a static transform.
    """

    translation: Vector
    rotation: Vector
    stamp_ns: int = 0

    @property
    def matrix(self) -> Vector:
        """The homogeneous matrix, of shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrix(self.rotation)
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: Any) -> Vector:
        """Map points, of shape (3,) or (n, 3)."""
        return np.asarray(points, np.float64) @ rotation_matrix(self.rotation).T + self.translation

    def after(self, first: "Transform") -> "Transform":
        """Return the transform that applies `first`, and then this one."""
        return Transform(
            self.apply(first.translation), quaternion_product(self.rotation, first.rotation), self.stamp_ns
        )

    def inverse(self) -> "Transform":
        """Return the opposite transform."""
        back = self.rotation * (-1.0, -1.0, -1.0, 1.0)
        return Transform(-rotation_matrix(back) @ self.translation, back, self.stamp_ns)


IDENTITY: Final = Transform(np.zeros(3), np.array((0.0, 0.0, 0.0, 1.0)))


def rotation_matrix(quaternion: Vector) -> Vector:
    """Return the matrix of a unit quaternion, of shape (3, 3)."""
    vector, w = quaternion[:3], quaternion[3]
    x, y, z = vector
    cross = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    result: Vector = (w * w - vector @ vector) * np.eye(3) + 2 * np.outer(vector, vector) + 2 * w * cross
    return result


def quaternion_product(left: Vector, right: Vector) -> Vector:
    """Return the quaternion that rotates by `right`, and then by `left`."""
    vector = left[3] * right[:3] + right[3] * left[:3] + np.cross(left[:3], right[:3])
    return np.append(vector, left[3] * right[3] - left[:3] @ right[:3])


def interpolated(before: Transform, after: Transform, stamp: int) -> Transform:
    """Return the transform at a time between two: translations linearly, rotations on the shortest arc."""
    part = (stamp - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    start, end = before.rotation, after.rotation
    # Both signs of a quaternion are the same rotation; the nearer one gives the shorter way.
    cosine = float(start @ end)
    if cosine < 0:
        end, cosine = -end, -cosine
    # For nearly equal rotations, the sines below would be almost zero, and the norm inaccurate.
    if cosine > _NEARLY_PARALLEL:
        rotation = start + part * (end - start)
    else:
        angle = np.arccos(cosine)
        rotation = np.sin((1 - part) * angle) * start + np.sin(part * angle) * end
    translation = before.translation + part * (after.translation - before.translation)
    return Transform(translation, rotation / np.linalg.norm(rotation), stamp)


class _Frame:
    """One frame: its parent, and its transforms to it in the order of their stamps."""

    def __init__(self, parent: str, *, static: bool) -> None:
        self.parent = parent
        self.static = static
        # Ordered by stamp, and no older than `HISTORY_S` before the newest; one entry if static, and never empty after
        # the first `add`.
        self.history: list[Transform] = []

    def add(self, transform: Transform) -> None:
        history = self.history
        # A static transform is valid at all times, so that only the last one counts.
        if self.static:
            history[:] = [transform]
            return
        if history and transform.stamp_ns < history[-1].stamp_ns - round(HISTORY_S * 1e9):
            history.clear()  # the clock was set back, or a recording is played again
        # Several publishers may send a frame, so messages need not come in order.
        insort(history, transform, key=_stamp)
        oldest = history[-1].stamp_ns - round(HISTORY_S * 1e9)
        del history[: max(bisect_left(history, oldest, key=_stamp), len(history) - MAX_ENTRIES)]

    def at(self, stamp: int, name: str) -> Transform:
        history = self.history
        if self.static:
            return history[0]
        # Without interpolation, so that the newest transform can be used at its own time.
        index = bisect_left(history, stamp, key=_stamp)
        if index < len(history) and history[index].stamp_ns == stamp:
            return history[index]
        if not 0 < index < len(history):
            side = (
                f"{(stamp - history[-1].stamp_ns) / 1e9:.3f} s after the newest"
                if index
                else (f"{(history[0].stamp_ns - stamp) / 1e9:.3f} s before the oldest")
            )
            raise ExtrapolationError(
                f"the transform from {name} to {self.parent} is not known at {stamp / 1e9:.3f}: this is {side} one"
            )
        return interpolated(history[index - 1], history[index], stamp)


def _stamp(transform: Transform) -> int:
    return transform.stamp_ns


class TransformTree:
    """The frames of a robot, from messages of `tf2_msgs/TFMessage`.

    Attributes:
        unusable: Number of unusable transforms in the messages.
    """

    def __init__(self) -> None:
        # By name; a root, which has no parent, has no entry.
        self._frames: dict[str, _Frame] = {}
        # The sum of the lengths of all histories, at most `MAX_TRANSFORMS`.
        self._stored = 0
        self.unusable = 0

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({*self._frames, *(frame.parent for frame in self._frames.values())})

    def take(self, message: dict[str, Any], *, static: bool) -> None:
        """Add the transforms of a message; unusable ones are counted."""
        transforms = message.get("transforms")
        for each in transforms if isinstance(transforms, list) else []:
            try:
                header, body = each["header"], each["transform"]
                parent, child = header["frame_id"].lstrip("/"), each["child_frame_id"].lstrip("/")
                stamp = 0 if static else stamp_ns(header["stamp"])
                translation = _numbers(body["translation"], "xyz")
                rotation = _numbers(body["rotation"], "xyzw")
                # Robots send quaternions that are not quite unit, or all zeros. Clipped first, because squares of large
                # numbers overflow.
                norm = float(np.linalg.norm(rotation.clip(-2, 2)))
                usable = (
                    bool((np.abs(translation) <= LARGEST).all())
                    and bool((np.abs(rotation) <= 2).all())
                    and 0.5 < norm < 1.5
                    and 0 < len(parent) <= MAX_NAME
                    and 0 < len(child) <= MAX_NAME
                )
            except (TypeError, KeyError, ValueError, AttributeError, OverflowError):
                usable = False
            if usable and stamp is not None and parent != child:
                self.add(parent, child, Transform(translation, rotation / norm, stamp), static=static)
            else:
                self.unusable += 1

    def add(self, parent: str, child: str, transform: Transform, *, static: bool = False) -> None:
        """Add a transform from frame `child` to its parent; another parent replaces the earlier one."""
        frame = self._frames.get(child)
        if frame is None and len(self._frames) >= MAX_FRAMES:
            self.unusable += 1
            return
        # Transforms to one parent must not be interpolated with those to another.
        if frame is None or frame.parent != parent or frame.static != static:
            self._stored -= len(frame.history) if frame is not None else 0
            self._frames[child] = frame = _Frame(parent, static=static)
        self._stored -= len(frame.history)
        frame.add(transform)
        self._stored += len(frame.history)
        if self._stored > MAX_TRANSFORMS:
            for each in self._frames.values():
                del each.history[: len(each.history) // 2]
            self._stored = sum(len(each.history) for each in self._frames.values())

    def lookup(self, target: str, source: str, stamp: int | None = None) -> Transform:
        """Return the transform from frame `source` to frame `target`.

        Args:
            target: Name of the frame in which coordinates are wanted.
            source: Name of the frame in which they are given.
            stamp: Nanoseconds since 1970; None for the latest time at which all parts are known.

        Raises:
            FrameUnknownError: One of them is not known.
            FramesUnconnectedError: They have no common ancestor.
            ExtrapolationError: A part is not known at that time.
        """
        # tf of ROS 1 wrote names with a slash.
        target, source = target.lstrip("/"), source.lstrip("/")
        for name in (target, source):
            if name not in self._frames and name not in self.frames:
                known = ", ".join(self.frames[:20]) or "none"
                raise FrameUnknownError(f"frame {name} is not known; known are {known}")
        # Up from the source to the first frame that is also above the target, and down to that.
        up, down = self._ancestors(source), self._ancestors(target)
        below = set(down)
        common = next((name for name in up if name in below), None)
        if common is None:
            raise FramesUnconnectedError(
                f"frames {source} and {target} are not connected: they belong to the trees of {up[-1]} and {down[-1]}"
            )
        up, down = up[: up.index(common)], down[: down.index(common)]
        if stamp is None:
            moving = [self._frames[name] for name in (*up, *down) if not self._frames[name].static]
            stamp = min((frame.history[-1].stamp_ns for frame in moving), default=0)
        there = self._chain(up, stamp)
        back = self._chain(down, stamp).inverse()
        found = back.after(there)
        return Transform(found.translation, found.rotation, stamp)

    def _ancestors(self, name: str) -> list[str]:
        """Return a frame and its ancestors; a loop ends where it closes."""
        names = {name: None}
        while (frame := self._frames.get(name)) is not None and frame.parent not in names:
            name = frame.parent
            names[name] = None
        return list(names)

    def _chain(self, names: Sequence[str], stamp: int) -> Transform:
        result = IDENTITY
        for name in names:
            result = self._frames[name].at(stamp, name).after(result)
        return result


def _numbers(fields: dict[str, Any], names: str) -> Vector:
    return np.array([float(fields[name]) for name in names])
