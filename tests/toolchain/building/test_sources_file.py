"""A sources file: which variable comes from which topic, and every mistake in it as a sentence with its line."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.errors import PathError
from bridge.fields import parse_path
from tests.toolchain.running import assert_refused, done, toolchain
from toolchain.building.sources import read_sources
from toolchain.deployment import Variable, load_deployment
from toolchain.deployment.sections import MESSAGE_PATH
from toolchain.errors import BuildError

MODEL = """
import numpy as np
from toolchain.models.model import Known, Model, dimension

def model(path: str = ""):
    table = np.full((4, 4), 0.25)
    return Model(name="tiny", searched=(dimension("s", size=4),),
                 known=tuple(Known(name=name, table=table, path=path) for name in ("near", "left", "turn")))
"""
FILE = """\
[[source]]
topic = "/range"
type = "sensor_msgs/Range"
variables = { near = "range" }

[[source]]
uri = "ws://two:9090"
topic = "/scan"
type = "sensor_msgs/LaserScan"
compression = "cbor"
variables = { left = "ranges[3]" }

[[source]]
uri = "ws://two:9090"
topic = "/imu"
type = "sensor_msgs/Imu"
"""
VARIABLES = tuple(Variable(name=name, bits=3, values=4) for name in ("near", "left", "turn"))


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "sources.toml"
        path.write_text(text)
        return path

    return write


def build(tmp_path, *flags):
    case = tmp_path / "case"
    case.mkdir(exist_ok=True)
    (case / "model.py").write_text(MODEL)
    return toolchain("build", case, "-o", tmp_path / "out", *flags)


def test_a_build_from_several_topics(tmp_path, written):
    path = str(written(FILE))
    result = done(
        build(
            tmp_path, "--sources", path, "--uri", "robot:Robot 7", "--tolerance", "0.2", "--set", "path=a.b"
        )
    )
    deployment = load_deployment(tmp_path / "out")
    assert [(each.uri, each.topic, each.compression) for each in deployment.sources] == [
        ("robot:Robot 7", "/range", "none"),
        ("ws://two:9090", "/scan", "cbor"),
        ("ws://two:9090", "/imu", "none"),
    ]
    places = [(each.name, each.source, each.path) for each in deployment.variables]
    assert places == [("near", 0, "range"), ("left", 1, "ranges[3]"), ("turn", 2, "a.b")]
    assert deployment.tolerance_s == 0.2
    assert "Readings come from 3 topics, together where their stamps are within 0.2 s:\n" in result.stdout
    file = tmp_path / "out" / "deployment.toml"
    assert file.read_text().count("compression") == 1
    file.write_text(file.read_text().replace('"cbor"', '"none"').replace("ws://two", "ws://three"))
    assert {each.compression for each in load_deployment(tmp_path / "out").sources} == {"none"}


def test_a_prior_of_one_of_them(tmp_path, written):
    text = FILE.replace('type = "sensor_msgs/Imu"', 'type = "a/B"\nprior = "data"')
    flags = ("--sources", str(written(text)), "--uri", "ws://one:9090")
    done(build(tmp_path, *flags, "--prior-mode", "written"))
    prior = load_deployment(tmp_path / "out").prior
    assert (prior.source, prior.path) == (2, "data")
    assert_refused(build(tmp_path, *flags), "--prior-mode written")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("", "", 2),
        ("near = ", "naer = ", 4),
        ("left = ", "near = ", 11),
        ("ranges[3]", "ranges[-3]", 11),
        ("/scan", "scan me", 8),
        ('topic = "/imu"', 'topic = "/scan"', 15),
        ('{ left = "ranges[3]" }', "{}", 11),
        ('variables = { left = "ranges[3]" }\n', "", 14),
        ("variables = { ", 'prior = "p"\nvariables = { ', 12),
        ('{ near = "range" }', '{ near = "range", turn = "x" }', 13),
    ],
)
def test_mistakes(written, old, new, line):
    path = written(FILE.replace(old, new))
    with pytest.raises(BuildError) as caught:
        read_sources(path, None if old == new else "ws://one:9090").place(VARIABLES)
    assert (caught.value.path, caught.value.line) == (path, line)


def test_a_variable_that_no_source_has(written):
    path = written(FILE + 'variables = { turn = "angular_velocity.z" }\n')
    more = tuple(Variable(name=name, bits=3, values=4) for name in ("back", "front"))
    file = read_sources(path, "ws://one:9090")
    assert [each.source for each in file.place(VARIABLES)] == [0, 1, 2]
    with pytest.raises(BuildError, match="no source has back, front; add them to the variables"):
        file.place(VARIABLES + more)


@pytest.mark.parametrize("flags", [("--topic", "/t"), ("--type", "a/B"), ("--prior-path", "p")])
def test_flags_that_say_the_same(tmp_path, written, flags):
    assert_refused(build(tmp_path, "--sources", written(FILE), *flags), *flags)


@given(st.text(st.sampled_from("ab_3[].x-"), max_size=12) | st.from_regex(MESSAGE_PATH, fullmatch=True))
def test_a_place_is_what_the_subscriber_takes(path):
    try:
        parse_path(path)
        taken = True
    except PathError:
        taken = False
    assert bool(MESSAGE_PATH.fullmatch(path)) == taken


def test_many_sources_are_too_many(written):
    table = '[[source]]\nuri = "ws://one:9090"\ntopic = "/t{}"\ntype = "a/B"\nvariables = {{ near = "x" }}\n'
    with pytest.raises(BuildError, match="at most 256 items"):
        read_sources(written("".join(map(table.format, range(257)))), None)
