"""The publisher without a deployment: what a line may be, which field gets it, and that the last one has arrived."""

import sys

import pytest

from bridge.client import connect
from bridge.codecs.message_check import SCALAR, FieldType, bundled_definitions
from bridge.hub.limits import HubLimits
from services.commands import publisher
from services.errors import InputLineError, SettingsError
from services.pipeline.connections import NotReceivableError
from services.pipes import lines
from services.pipes.arrays import ArrayField, array_field, publish_arrays
from services.settings import Settings
from tests.bridge.hub.sockets import running_hub
from tests.command_runner import invoke
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE
from toolchain.deployment import Source

LASER, MULTI_ARRAY = "sensor_msgs/LaserScan", "std_msgs/Float64MultiArray"


def of(element, length=0):
    return ArrayField("p/T", ("inner", "data"), FieldType(element, length))


@pytest.mark.parametrize(
    ("line", "element", "numbers"),
    [
        *((line, "float64", [0.5, 100.0]) for line in (b"[0.5, 100]", b" .5 1e2\r\n", b"0.5,\t+100.\n")),
        (b"7", "double", [7.0]),
        (b"-128 127", "int8", [-128, 127]),
        (b"[2.0, 255]", "uint8", [2, 255]),
        (b"0" * 20 + b"18446744073709551615", "uint64", [2**64 - 1]),
        (b"3.4028235e+38", "float32", [3.4028235e38]),
        (b"9223372036854775807,-9223372036854775808", "int64", [2**63 - 1, -(2**63)]),
    ],
)
def test_the_numbers_of_a_line(line, element, numbers):
    found = of(element).numbers(line, 1)
    assert (found, [type(each) for each in found]) == (numbers, [type(each) for each in numbers])


@pytest.mark.parametrize(
    ("line", "element"),
    [
        *((row, "float64") for row in (b"nan", b"[NaN]", b"1e999", b"[1e999]", b"-inf", b"9" * 5000)),
        *((row, "float64") for row in (b"one two", b"1,,2", b"0,5 0,5", b"1_0", b"[]", b"[true]", b"[[1]]")),
        *((row, "float64") for row in (b'["1"]', b"[1", b"\xff\xb2", b"[" * 10**5, b'{"data": [1]}')),
        *((b"300", "uint8"), (b"-1", "uint8"), (b"1.5", "int16"), (b"18446744073709551616", "uint64")),
        *((b"1e39", "float32"), (b"-1e39", "float"), (b"9007199254740993.0", "int64")),
    ],
)
def test_a_line_that_cannot_be_the_array_is_refused(line, element):
    with pytest.raises(InputLineError, match="line 3 of standard input"):
        of(element).numbers(line, 3)


def test_an_array_of_fixed_length():
    assert of("float64", 2).numbers(b"1 2", 1) == [1, 2]
    with pytest.raises(InputLineError, match="has 1 numbers"):
        of("float64", 2).numbers(b"1", 1)


def test_the_message_of_an_array():
    assert of("int16").message([1, 2]) == {"inner": {"data": [1, 2]}}
    assert of("uint8").message([1, 2]) == {"inner": {"data": b"\1\2"}}
    assert of("uint8").holds({"inner": {"data": "AQI="}}, [1, 2])
    assert of("float32").holds({"inner": {"data": [0.10000000149011612]}}, [0.1])
    assert not of("float32").holds({"inner": {"data": [0.1001]}}, [0.1])
    assert not of("float32").holds({"inner": None, "data": [0.1]}, [0.1])


def test_which_array_of_a_type_is_meant():
    scan = bundled_definitions(LASER, 2)
    assert array_field(scan, LASER, "ranges").kind == FieldType("float32", 0)
    for path in (None, "rages", "range_min"):
        with pytest.raises(SettingsError, match=r"ranges \(float32\[\]\), intensities"):
            array_field(scan, LASER, path)
    pose = "geometry_msgs/msg/PoseWithCovarianceStamped"
    found = array_field(bundled_definitions(pose, 2), pose, None)
    assert (found.path, found.kind.length) == ("pose.covariance", 36)
    with pytest.raises(SettingsError, match="needs one with an array"):
        array_field({"p/T": {"inner": FieldType("p/T", SCALAR)}}, "p/T", None)


async def published(monkeypatch, tmp_path, text, uri, type_=MULTI_ARRAY, *, path=None, **settings):
    """Publish a text on /t."""
    (tmp_path / "input").write_bytes(text)
    settings = Settings(**{"seen_timeout": PATIENCE} | settings)
    with (tmp_path / "input").open() as source:
        monkeypatch.setattr(sys, "stdin", source)
        return await publish_arrays(settings, Source(uri=uri, topic="/t", type=type_), path)


@pytest.mark.parametrize(
    ("type_", "path", "received"),
    [
        (MULTI_ARRAY, None, [{"data": [1.0, 2.0]}, {"data": [3.0]}]),
        ("std_msgs/msg/UInt8MultiArray", None, [{"data": "AQI="}, {"data": "Aw=="}]),
        (LASER, "intensities", [{"intensities": [1.0, 2.0]}, {"intensities": [3.0]}]),
    ],
)
async def test_each_line_is_a_message(monkeypatch, tmp_path, capsys, type_, path, received):
    async with running_hub(ros_version=2) as port, connect(uri := f"ws://127.0.0.1:{port}") as ros:
        subscription = ros.subscribe("/t", type_)
        await ros.topics()  # answered after the subscription
        assert await published(monkeypatch, tmp_path, b"1 2\n\n3", uri, type_, path=path) == 0
        assert capsys.readouterr().err.splitlines()[-1] == "2 published"
        for one in received:
            message = await subscription.next(PATIENCE)
            assert message.msg.items() >= one.items()


async def test_a_message_that_the_server_would_not_take(monkeypatch, tmp_path):
    async with running_hub(limits=HubLimits(message_bytes=10_000)) as port:
        with pytest.raises(InputLineError, match="line 2 of standard input: .*bytes"):
            await published(monkeypatch, tmp_path, b"1\n" + b"1 " * 5000, f"ws://127.0.0.1:{port}")


async def test_a_bad_line_ends_it_after_those_before(monkeypatch, tmp_path):
    monkeypatch.setattr(lines, "LINE_LIMIT", 10)
    async with running_hub() as port, connect(uri := f"ws://127.0.0.1:{port}") as ros:
        subscription = ros.subscribe("/t", MULTI_ARRAY)
        await ros.topics()
        for text, match in ((b"1\nx\n", "line 2"), (b"1\n" + b" " * 20, "line 2"), (b"\n", "is empty")):
            with pytest.raises(InputLineError, match=match):
                await published(monkeypatch, tmp_path, text, uri)
        for _ in range(2):
            assert (await subscription.next(PATIENCE)).msg["data"] == [1.0]


async def test_a_message_that_the_server_loses_is_named(monkeypatch, tmp_path):
    async with FakeRosbridge(max_size=1000) as fake:
        text = b"1\n" + b"2 " * 1000 + b"\n"
        with pytest.raises(
            NotReceivableError, match="2 published, of which 1 .* first line 2 of standard input"
        ):
            await published(monkeypatch, tmp_path, text, fake.uri, seen_timeout=PATIENCE / 10)
        assert [each["msg"]["data"] for each in fake.ops("publish", topic="/t")] == [[1.0]]


async def test_what_the_server_does_not_pass_on_is_reported(monkeypatch, tmp_path):
    async with FakeRosbridge() as fake, connect(fake.uri) as robot:
        fake.refused_topics = {"/t"}
        with pytest.raises(NotReceivableError, match="3 published, of which 3 .* first line 1"):
            await published(monkeypatch, tmp_path, b"1\n2\n3", fake.uri, seen_timeout=0.05)
        with pytest.raises(SettingsError, match="boat_msgs/Sensors are not known"):
            await published(monkeypatch, tmp_path, b"1", fake.uri, "boat_msgs/Sensors")
        fake.rosapi = True
        with pytest.raises(NotReceivableError, match="/t cannot be received"):
            await published(monkeypatch, tmp_path, b"1", fake.uri, seen_timeout=0.05)
        fake.refused_topics = set()
        await robot.advertise("/t", "std_msgs/String")
        with pytest.raises(NotReceivableError, match="/t is std_msgs/String"):
            await published(monkeypatch, tmp_path, b"1", fake.uri)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ((), "--uri"),
        (("--uri", "ws://127.0.0.1:1", "--topic", "t"), "--topic"),
        (("--uri", "ws://127.0.0.1:1", "--type", "String"), "--type"),
    ],
)
def test_flags_of_the_publisher(flags, said):
    ended = invoke(publisher.app, flags)
    assert (ended.exit_code, ended.stderr.count("\n")) == (2, 1)
    assert said in ended.stderr
