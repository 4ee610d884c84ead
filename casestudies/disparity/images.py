"""Conversion of sensor_msgs/Image and stereo_msgs/DisparityImage, and pairing of stereo images by their stamps."""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bridge.stamps import header_stamp_ns

IMAGE_TYPE: Final = "sensor_msgs/Image"
DISPARITY_TYPE: Final = "stereo_msgs/DisparityImage"
_DTYPES: Final = {"mono8": "u1", "8UC1": "u1", "32FC1": "f4"}
"""Types of a pixel by encoding."""
_MOST_PIXELS: Final = 1 << 19
"""Maximum size of an image, because costs and likelihoods take 0.8 kB of memory for each pixel."""
_WAITING: Final = 16
"""Maximum number of images of each camera that wait for the other camera's."""


class BadImageError(Exception):
    """A message is not a usable image, for example because it has no stamp."""


def read_image(message: Mapping[str, Any], *encodings: str) -> NDArray[Any]:
    """Return a sensor_msgs/Image as an array [height, width].

    Raises a BadImageError if the encoding of the image is not in `encodings`, or if the image is damaged or too large.
    """
    encoding = message.get("encoding")
    if encoding not in encodings:
        raise BadImageError(f"its encoding is {str(encoding)[:20]!r}, expected {' or '.join(encodings)}")
    height: Any = message.get("height")
    width: Any = message.get("width")
    step: Any = message.get("step")
    data: Any = message.get("data")
    try:
        if isinstance(data, str):
            data = base64.b64decode(data, validate=True)
        # of a list, because bytes(10**12) would be a terabyte
        octets = data if isinstance(data, bytes) else bytes(list(data))
        dtype = np.dtype(_DTYPES[encoding]).newbyteorder(">" if message.get("is_bigendian") else "<")
        rows = np.frombuffer(octets, np.uint8).reshape(height, step)[:, : width * dtype.itemsize]
        image = np.ascontiguousarray(rows).view(dtype)
    except (binascii.Error, TypeError, ValueError):
        image = np.empty((0, 0))
    if image.size > _MOST_PIXELS:
        raise BadImageError(
            f"it has {width} x {height} pixels, expected at most {_MOST_PIXELS}; scale it down"
        )
    if image.shape != (height, width) or not image.size:
        raise BadImageError(
            f"its data do not hold {height} rows of {step} bytes with {width} pixels of {encoding}"
        )
    return image


def image_message(
    image: NDArray[Any], head: Mapping[str, Any], encoding: Literal["mono8", "32FC1"]
) -> dict[str, Any]:
    """Return pixels [height, width] as a sensor_msgs/Image with the header `head`."""
    pixels = np.ascontiguousarray(image, dtype=np.dtype(_DTYPES[encoding]).newbyteorder("<"))
    height, width = pixels.shape
    return {
        "header": dict(head),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": width * pixels.itemsize,
        "data": pixels.tobytes(),
    }


def disparity_message(
    disparity: NDArray[np.float64],
    head: Mapping[str, Any],
    *,
    disparities: int,
    focal_px: float | None,
    baseline_m: float,
    ros_version: Literal[1, 2] | None,
) -> dict[str, Any]:
    """Return disparities in pixels, float64[height, width], as a stereo_msgs/DisparityImage.

    A negative disparity means unknown, as in stereo_image_proc. If `focal_px` is None, the message gives the image's
    width as the focal length. The field of the baseline is `T` in ROS 1 and `t` in ROS 2.
    """
    height, width = disparity.shape
    window = {"x_offset": 0, "y_offset": 0, "height": height, "width": width, "do_rectify": False}
    return {
        "header": dict(head),
        "image": image_message(disparity, head, "32FC1"),
        "f": float(width) if focal_px is None else focal_px,
        "t" if ros_version == 2 else "T": baseline_m,
        "valid_window": window,
        "min_disparity": 0.0,
        "max_disparity": float(disparities - 1),
        "delta_d": 1.0,
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoImages:
    """A left and a right image with the same stamp, uint8[height, width], and the header of the left image."""

    stamp_ns: int
    head: Mapping[str, Any]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


class ImagePairs:
    """The images of two cameras, paired by equal stamps.

    Attributes:
        unpaired: Number of images of the left camera, and of the right camera, since the last pair. A silent camera
            has 0.
    """

    def __init__(self) -> None:
        self.unpaired = [0, 0]
        # The images of each camera that wait for their pair, by stamp in the order of arrival; no stamp is in both.
        self._waiting: tuple[dict[int, Mapping[str, Any]], ...] = ({}, {})

    def add(self, side: int, message: Mapping[str, Any]) -> StereoImages | None:
        """Add an image of camera 0 (left) or 1 (right), and return the completed pair, or None.

        A completed pair discards all older images of both cameras. Newer images continue to wait for their partners.
        Raises a BadImageError if the image has no stamp, or if an image of the pair is unusable.
        """
        stamp_ns = header_stamp_ns(message)
        if stamp_ns is None:
            raise BadImageError("its header has no stamp, by which left and right are paired")
        self.unpaired[side] += 1
        other = self._waiting[1 - side].pop(stamp_ns, None)
        if other is None:
            self._waiting[side][stamp_ns] = message
            if len(self._waiting[side]) > _WAITING:
                del self._waiting[side][next(iter(self._waiting[side]))]
            return None
        self.unpaired = [0, 0]
        for waiting in self._waiting:
            for older in [each for each in waiting if each < stamp_ns]:
                del waiting[older]
        left, right = (message, other) if side == 0 else (other, message)
        images = [read_image(each, "mono8", "8UC1") for each in (left, right)]
        if images[0].shape != images[1].shape:
            ours, theirs = (f"{each.shape[1]} x {each.shape[0]}" for each in images)
            raise BadImageError(
                f"the left image has {ours} pixels and the right one {theirs}, expected the same of both"
            )
        return StereoImages(stamp_ns=stamp_ns, head=left["header"], left=images[0], right=images[1])

    def silence(self, left: str, right: str) -> str:
        """Return a sentence that explains why no pair arrives. `left` and `right` are the topics of the cameras."""
        if all(self.unpaired):
            return f"images come on {left} and {right}, but no two with equal stamps: synchronise the cameras"
        if not any(self.unpaired):
            return f"no images come on {left} and {right}: are the cameras running?"
        heard, silent = (left, right) if self.unpaired[0] else (right, left)
        return f"images come on {heard}, but none on {silent}: is that camera running?"
