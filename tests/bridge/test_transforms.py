"""Transforms between frames: chains, times and errors, compared with plain matrices."""

import math

import numpy as np
import pytest

from bridge import transforms
from bridge.errors import ExtrapolationError, FramesUnconnectedError, FrameUnknownError
from bridge.stamps import header
from bridge.transforms import MAX_ENTRIES, MAX_NAME, Transform, TransformTree, interpolated, rotation_matrix

SECOND = 10**9


def turned(x, degrees, stamp=0, axis=(0, 0, 1)):
    half = math.radians(degrees) / 2
    rotation = np.array([*(math.sin(half) * np.array(axis)), math.cos(half)])
    return Transform(np.array([x, 0.0, 0.0]), rotation, stamp)


def message(parent, child, transform):
    body = {
        "translation": dict(zip("xyz", transform.translation.tolist(), strict=True)),
        "rotation": dict(zip("xyzw", transform.rotation.tolist(), strict=True)),
    }
    return {
        "transforms": [
            {"header": header(transform.stamp_ns, parent), "child_frame_id": child, "transform": body}
        ]
    }


def test_composition_and_inverse_are_those_of_matrices():
    one, two = turned(1, 30, axis=(0, 1, 0)), turned(2, 70, axis=(1, 0, 0))
    assert np.allclose(one.after(two).matrix, one.matrix @ two.matrix)
    assert np.allclose(one.inverse().matrix, np.linalg.inv(one.matrix))
    points = np.arange(6.0).reshape(2, 3)
    assert np.allclose(one.apply(points)[1], (one.matrix @ [3, 4, 5, 1])[:3])
    assert np.allclose(rotation_matrix(turned(0, 90).rotation) @ [1, 0, 0], [0, 1, 0])


@pytest.mark.parametrize(("part", "degrees"), [(0.25, 20), (0.5, 40)])
def test_interpolation_takes_the_shortest_arc(part, degrees):
    before, after = turned(0, 0, 0), turned(4, 80, SECOND)
    for end in (after, Transform(after.translation, -after.rotation, SECOND)):
        found = interpolated(before, end, round(part * SECOND))
        assert np.allclose(found.matrix, turned(4 * part, degrees).matrix)


@pytest.fixture
def tree():
    """map -> odom -> base -> laser (static), base -> camera (static); another tree: world -> arm."""
    tree = TransformTree()
    for second in range(3):
        tree.take(message("map", "odom", turned(10, 0, second * SECOND)), static=False)
        tree.take(message("odom", "/base", turned(second, 0, second * SECOND)), static=False)
    tree.take(message("base", "laser", turned(0.5, 90)), static=True)
    tree.take(message("base", "camera", turned(-0.5, 0)), static=True)
    tree.take(message("world", "arm", turned(1, 0, SECOND)), static=False)
    return tree


@pytest.mark.parametrize(
    ("target", "source", "stamp", "point", "mapped"),
    [
        ("map", "base", None, (0, 0, 0), (12, 0, 0)),
        ("map", "/laser", None, (1, 0, 0), (12.5, 1, 0)),
        ("laser", "map", None, (12.5, 1, 0), (1, 0, 0)),
        ("camera", "laser", None, (1, 0, 0), (1, 1, 0)),
        ("map", "base", 3 * SECOND // 2, (0, 0, 0), (11.5, 0, 0)),
        ("base", "base", 99 * SECOND, (1, 2, 3), (1, 2, 3)),
        ("camera", "laser", 99 * SECOND, (1, 0, 0), (1, 1, 0)),
    ],
)
def test_chains(tree, target, source, stamp, point, mapped):
    assert np.allclose(tree.lookup(target, source, stamp).apply(point), mapped)


@pytest.mark.parametrize(
    ("target", "source", "stamp", "error"),
    [
        ("map", "gripper", None, FrameUnknownError),
        ("map", "arm", None, FramesUnconnectedError),
        ("map", "base", 3 * SECOND, ExtrapolationError),
        ("map", "base", -1, ExtrapolationError),
    ],
)
def test_errors(tree, target, source, stamp, error):
    with pytest.raises(error):
        tree.lookup(target, source, stamp)


def test_a_loop_of_frames_ends():
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.add(parent, child, turned(1, 0, 1))
    tree.lookup("a", "c")
    tree.add("x", "y", turned(1, 0, 1))
    with pytest.raises(FramesUnconnectedError):
        tree.lookup("a", "y")


def test_the_history_is_limited():
    tree = TransformTree()
    for second in range(20):
        tree.add("a", "b", turned(second, 0, second * SECOND))
    tree.lookup("a", "b", 10 * SECOND)
    with pytest.raises(ExtrapolationError):
        tree.lookup("a", "b", 8 * SECOND)
    for count in range(MAX_ENTRIES + 10):
        tree.add("a", "c", turned(0, 0, count))
    with pytest.raises(ExtrapolationError):
        tree.lookup("a", "c", 5)


@pytest.mark.parametrize(
    "change",
    [
        {"header": 1},
        {"child_frame_id": 1},
        {"child_frame_id": ""},
        {"transform": {}},
        {"header": {"stamp": "now", "frame_id": "a"}},
        {
            "transform": {
                "translation": {"x": 0, "y": 0, "z": 0},
                "rotation": {"x": 0, "y": 0, "z": 0, "w": 0},
            }
        },
    ],
)
def test_unusable_transforms_are_counted(change):
    tree = TransformTree()
    (one,) = message("a", "b", turned(1, 0, 1))["transforms"]
    tree.take({"transforms": [one | change, one, 3]}, static=False)
    assert (tree.unusable, tree.frames) == (2, ["a", "b"])
    tree.take({"transforms": 1}, static=False)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [[1.0], None, 10**400, "nan", -1e101, math.inf])
@pytest.mark.parametrize("part", ["translation", "rotation"])
def test_a_transform_whose_numbers_are_not_numbers_is_unusable(part, value):
    tree, given = TransformTree(), message("map", "base", turned(0, 0))
    fields = given["transforms"][0]["transform"][part]
    fields |= dict.fromkeys(fields, value)
    tree.take(given, static=True)
    assert (tree.frames, tree.unusable) == ([], 1)


def test_a_frame_with_ever_new_parents_and_long_names_take_no_memory():
    tree = TransformTree()
    for number in range(100):
        tree.take(message(f"parent{number}", "base", turned(0, 0, number)), static=False)
    assert tree.frames == ["base", "parent99"]
    tree.take(message("map", "a" * (MAX_NAME + 1), turned(0, 0)), static=False)
    tree.take(message("a" * (MAX_NAME + 1), "arm", turned(0, 0)), static=False)
    assert (tree.frames, tree.unusable) == (["base", "parent99"], 2)


def test_the_transforms_of_all_frames_are_bounded_and_each_frame_keeps_its_newest(monkeypatch):
    monkeypatch.setattr(transforms, "MAX_TRANSFORMS", 40)
    tree = TransformTree()
    for number in range(400):
        tree.take(message("map", f"base{number // 50}", turned(number, 0, number)), static=False)
    known = 0
    for frame in range(8):
        assert tree.lookup("map", f"base{frame}").translation[0] == 50 * frame + 49
        for number in range(50 * frame, 50 * frame + 50):
            try:
                tree.lookup("map", f"base{frame}", number)
            except ExtrapolationError:
                continue
            known += 1
    assert known <= 40


def test_a_clock_that_is_set_back_clears_the_history():
    tree = TransformTree()
    for stamp in (10**15, 5 * SECOND, 6 * SECOND):
        tree.take(message("map", "base", turned(stamp / SECOND, 0, stamp)), static=False)
    assert tree.lookup("map", "base", 5_500_000_000).translation[0] == pytest.approx(5.5)
