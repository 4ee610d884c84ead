"""Renderer of stereo pairs. Two rectified cameras see spheres and boxes with a solid texture in front of a wall.

Positions are in metres from the left camera: x points right, y down, and z forward. The right camera is `BASELINE` to
the right of the left camera.
"""

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

BASELINE: Final = 0.1
"""Distance between the cameras in metres."""
FOCAL: Final = 1.0
"""Focal length of the cameras, as a multiple of the image's width."""
NOISE: Final = 1.5
"""Standard deviation of the cameras' noise, in grey levels."""
RIGHT_GAIN: Final = 0.95
"""Brightness of the right image relative to the left image. Real cameras also differ in brightness."""
_OCTAVES: Final = tuple(1.6 / 2**octave for octave in range(8))
"""Periods of the texture, in metres."""
_TOLERANCE: Final = 1e-6
"""Relative difference of distances below which two points count as the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """A rectified stereo pair, and the true disparities and occlusions of the left image."""

    left: NDArray[np.uint8]
    """uint8[height, width]: grey levels."""
    right: NDArray[np.uint8]
    disparity: Array
    """float64[height, width]: true disparity. A point is this many pixels further left in the right image."""
    occluded: NDArray[np.bool_]
    """bool[height, width]: true for a pixel whose point is hidden from the right camera or outside the right image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sphere:
    centre: Array
    radius: float

    def distance(self, origin: Array, rays: Array) -> Array:
        """Return the distance at which each ray first hits the sphere, float64[pixels], in lengths of the ray.

        `rays` is float64[pixels, 3]. The distance is infinite if a ray misses the sphere.
        """
        away = origin - self.centre
        a, b = (rays**2).sum(axis=1), rays @ away
        root = b**2 - a * (away @ away - self.radius**2)
        near = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (near > 0), near, np.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    low: Array
    high: Array

    def distance(self, origin: Array, rays: Array) -> Array:
        """Return the distance at which each ray enters the box, float64[pixels], in lengths of the ray.

        `rays` is float64[pixels, 3]. The distance is infinite if a ray misses the box.
        """
        with np.errstate(divide="ignore"):
            first, second = (self.low - origin) / rays, (self.high - origin) / rays
        enters = np.minimum(first, second).max(axis=1)
        leaves = np.maximum(first, second).min(axis=1)
        return np.where((enters < leaves) & (enters > 0), enters, np.inf)


class Scene:
    """A wall and a floor, with spheres and boxes of random size.

    The spheres and boxes move a little from one stereo pair to the next.
    """

    def __init__(self, seed: int) -> None:
        """Choose a scene at random. Equal seeds give equal pairs."""
        self._seed = seed
        random = np.random.default_rng(seed)
        self._spheres = [
            (np.array([random.uniform(*x), random.uniform(-0.4, 0.3), random.uniform(1.6, 3.2)]), size)
            for x, size in zip(((-1.1, -0.3), (0.2, 1.0)), random.uniform(0.25, 0.5, 2), strict=True)
        ]
        self._boxes = [
            (np.array([random.uniform(*x), 0.35, random.uniform(1.3, 2.6)]), size)
            for x, size in zip(((-0.8, 0.0), (0.1, 0.8)), random.uniform(0.15, 0.35, 2), strict=True)
        ]
        self._phases = random.uniform(0, 2 * np.pi, 4)
        # random values of the texture for each period; they repeat after 32 points
        self._lattices = random.uniform(-1, 1, (len(_OCTAVES), 32, 32, 32))

    def pair(self, number: int, width: int, height: int) -> Pair:
        """Render the pair `number`, from 0: two noisy images, and the true disparities of the left image."""
        things = self._things(number)
        down, across = np.mgrid[:height, :width] + 0.5
        focal = FOCAL * width
        rays = np.stack([across - width / 2, down - height / 2, np.full(across.shape, focal)], axis=-1)
        rays = rays.reshape(-1, 3) / focal  # so that a multiple of a ray is a depth
        eyes = np.zeros(3), np.array([BASELINE, 0.0, 0.0])
        depths = [np.min([thing.distance(eye, rays) for thing in things], axis=0) for eye in eyes]
        points = [eye + depth[:, np.newaxis] * rays for eye, depth in zip(eyes, depths, strict=True)]
        # a point that the left camera sees is occluded if something lies between it and the right camera
        back = points[0] - eyes[1]
        reached = np.min([thing.distance(eyes[1], back) for thing in things], axis=0)
        random = np.random.default_rng((self._seed, number))
        images = []
        for gain, point, depth in zip((1.0, RIGHT_GAIN), points, depths, strict=True):
            grey = gain * (128 + 110 * self._texture(point, depth / focal)) + random.normal(
                0, NOISE, len(rays)
            )
            images.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(height, width))
        disparity = (focal * BASELINE / depths[0]).reshape(height, width)
        return Pair(
            left=images[0],
            right=images[1],
            disparity=disparity,
            occluded=(reached < 1 - _TOLERANCE).reshape(height, width) | (across < disparity),
        )

    def _things(self, number: int) -> list[_Sphere | _Box]:
        sway = 0.25 * np.sin(0.3 * number + self._phases)[:, np.newaxis] * np.array([1.0, 0.0, 0.6])
        spheres = [
            _Sphere(centre=centre + move, radius=radius)
            for (centre, radius), move in zip(self._spheres, sway[:2], strict=True)
        ]
        boxes = [
            _Box(low=centre + move - half, high=centre + move + half)
            for (centre, half), move in zip(self._boxes, sway[2:], strict=True)
        ]
        wall = _Box(low=np.array([-20.0, -20.0, 5.0]), high=np.array([20.0, 20.0, 6.0]))
        floor = _Box(low=np.array([-20.0, 0.7, 0.1]), high=np.array([20.0, 0.8, 6.0]))
        return [wall, floor, *spheres, *boxes]

    def _texture(self, points: Array, pixel: Array) -> Array:
        """Return the brightness, about -1 to 1, of points, float64[points, 3]: noise of several periods.

        `pixel` is the size of a pixel at each point, in metres. Periods below two pixels are left out, because the two
        cameras would sample them differently.
        """
        brightness = np.zeros(len(points))
        for octave, period in enumerate(_OCTAVES):
            weight = np.clip(period / (2 * pixel) - 1, 0, 1) * (0.35 if period > 0.3 else 0.5)
            brightness += weight * self._noise(points / period, octave)
        return np.tanh(brightness)

    def _noise(self, places: Array, octave: int) -> Array:
        """Return random numbers on the integer lattice, -1 to 1, interpolated at places, float64[places, 3]."""
        corner = np.floor(places)
        part = places - corner
        part = part * part * (3 - 2 * part)
        total = np.zeros(len(places))
        for offset in np.ndindex(2, 2, 2):
            weight = np.where(offset, part, 1 - part).prod(axis=1)
            at = (corner.astype(np.int64) + offset) % len(self._lattices[octave])
            total += weight * self._lattices[octave][tuple(at.T)]
        return total
