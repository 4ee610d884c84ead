"""Images as messages, and what is said about those that cannot be used."""

import base64
import json

import numpy as np
import pytest

from bridge.codecs.json_codec import encode
from bridge.codecs.message_check import MessageCheck, bundled_definitions
from bridge.stamps import header
from casestudies.disparity.images import (
    BadImageError,
    ImagePairs,
    disparity_message,
    image_message,
    read_image,
)

GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)


def grey(stamp_ns=1, image=GREY, **changed):
    return image_message(image, header(stamp_ns, "left", 2), "mono8") | changed


@pytest.mark.parametrize("image", [GREY, np.array([[1.5, np.nan]], np.float32)])
def test_an_image_arrives_as_it_was_sent(image):
    encoding = "mono8" if image.dtype == np.uint8 else "32FC1"
    message = image_message(image, header(1, "left", 2), encoding)
    over_json = json.loads(encode(message))
    assert isinstance(over_json["data"], str)
    over_numbers = message | {"data": list(message["data"])}
    for each in (message, over_json, over_numbers):
        assert read_image(each, encoding).tobytes() == image.tobytes()


def test_rows_may_be_padded_and_floats_big_endian():
    padded = np.pad(GREY, ((0, 0), (0, 2)))
    assert (read_image(grey(step=6, data=padded.tobytes()), "mono8") == GREY).all()
    image = np.array([[1.5, -2.0]])
    message = image_message(image, {}, "32FC1") | {"is_bigendian": 1, "data": image.astype(">f4").tobytes()}
    assert (read_image(message, "32FC1") == image).all()


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"encoding": "rgb8"}, "'rgb8', expected mono8"),
        ({"encoding": None}, "expected mono8"),
        ({"data": b"short"}, "3 rows of 4 bytes"),
        ({"data": 10**12}, "3 rows"),
        ({"data": "no base64!"}, "3 rows"),
        ({"data": [300] * 12}, "3 rows"),
        ({"step": 3, "height": 4}, "4 rows of 3 bytes"),
        ({"height": -1}, "-1 rows"),
        ({"width": "4"}, "4 pixels"),
        ({"step": None}, "None bytes"),
        ({"height": 0, "data": b""}, "0 rows"),
        ({"height": 1024, "width": 1024, "step": 1024, "data": bytes(1 << 20)}, "1024 x 1024 pixels"),
    ],
)
def test_what_is_no_grey_image_is_named(changed, named):
    with pytest.raises(BadImageError, match=named) as error:
        read_image(grey(**changed), "mono8", "8UC1")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("version", [1, 2])
def test_a_disparity_image_is_that_of_the_ros_version(version):
    disparity = np.array([[3.0, -1.0]])
    message = disparity_message(
        disparity,
        header(1, "left", version),
        disparities=16,
        focal_px=160.0,
        baseline_m=0.1,
        ros_version=version,
    )
    type_ = "stereo_msgs/DisparityImage"
    MessageCheck(type_, bundled_definitions(type_, version))(message)
    assert message["T" if version == 1 else "t"] == 0.1
    assert (message["f"], message["max_disparity"]) == (160.0, 15.0)
    assert (read_image(message["image"], "32FC1") == disparity).all()


def test_images_of_one_stamp_are_a_pair():
    pairs = ImagePairs()
    assert pairs.add(0, grey(1)) is None
    assert pairs.add(0, grey(2)) is None
    assert pairs.add(1, grey(3)) is None
    pair = pairs.add(1, grey(2, GREY + 1))
    assert (pair.stamp_ns, pair.head) == (2, header(2, "left", 2))
    assert (pair.left == GREY).all()
    assert (pair.right == GREY + 1).all()
    # 1 is older than the newest pair, and the right camera is ahead with 3
    assert pairs.add(1, grey(1)) is None
    assert pairs.add(1, grey(4)) is None
    assert [pairs.add(0, grey(stamp)).stamp_ns for stamp in (3, 4)] == [3, 4]


def test_a_camera_alone_does_not_fill_the_memory():
    pairs = ImagePairs()
    for stamp in range(1, 1000):
        assert pairs.add(0, grey(stamp)) is None
    assert pairs.add(1, grey(1)) is None
    assert pairs.add(1, grey(999)).stamp_ns == 999


def test_a_silent_camera_and_different_stamps_are_told_apart():
    pairs = ImagePairs()
    assert "no images" in pairs.silence("/l", "/r")
    pairs.add(1, grey(1))
    assert "none on /l" in pairs.silence("/l", "/r")
    pairs.add(0, grey(2))
    assert "equal stamps" in pairs.silence("/l", "/r")


def test_images_without_stamps_and_of_two_sizes_are_refused():
    pairs = ImagePairs()
    with pytest.raises(BadImageError, match="no stamp"):
        pairs.add(0, grey() | {"header": {}})
    pairs.add(0, grey(5))
    with pytest.raises(BadImageError, match="4 x 3 pixels and the right one 3 x 4"):
        pairs.add(1, grey(5, GREY.T))


def test_base64_of_a_server_is_read():
    assert (read_image(grey(data=base64.b64encode(GREY.tobytes()).decode()), "mono8") == GREY).all()
