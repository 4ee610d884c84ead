"""Recordings through the machines: an interrupted run goes on, also of a filter, and the file has the same bytes."""

import os
from contextlib import suppress
from zlib import crc32

import numpy as np
import pytest

from tests.toolchain.builders import corridor
from tests.toolchain.building.test_filter import ASKED, UMBRELLA
from tests.toolchain.running import TARGET, assert_refused, build_model, done, toolchain
from toolchain.analysis import replay as replays
from toolchain.analysis.readings import recorded_frames
from toolchain.analysis.replay import PartFile, record_layout, replay
from toolchain.cluster import in_this_process
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError

LAYOUT = np.dtype([("crc", "<u8"), ("cycles", "<u8"), ("posterior", "<f8", 3)])


def stop_after_five(job, numbers, keep):
    in_this_process(job, numbers[:5], keep)
    raise KeyboardInterrupt


def backwards(job, numbers, keep):
    in_this_process(job, numbers[::-1], keep)


@pytest.fixture(params=["plain", "free", "filter", "two"])
def deployment(request, tmp_path):
    """A deployment of a corridor with two boards, with generators that run on, a filter, or a BM2."""
    folder = tmp_path / "deployment"
    if request.param in ("plain", "free"):
        options = {"rng_reset": "free", "stop": "own"} if request.param == "free" else {}
        build_model(corridor(), folder, partitions=2, **options)
    else:
        (tmp_path / "umbrella.bif").write_text(UMBRELLA)
        asked = (
            ASKED
            if request.param == "filter"
            else ("--searched", "rain", "--known", "umbrella", "--machine", "bm2")
        )
        done(toolchain("build", tmp_path / "umbrella.bif", *asked, "-o", folder, *TARGET))
    return load_deployment(folder)


@pytest.fixture
def recording(deployment, tmp_path):
    names = [variable.name for variable in deployment.variables]
    rows = ["yes", "yes", "no", "no", "maybe", "no", "yes", "maybe", "no", "no", "yes", "no"]
    if names == ["range", "loud"]:
        rows = [f"{at},{at % 2}" if at % 5 else ",1" for at in range(12)]
    path = tmp_path / "recording.csv"
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    return path


def test_an_interrupted_run_goes_on_to_the_same_bytes(deployment, recording, tmp_path, monkeypatch):
    frames = recorded_frames(recording, deployment.variables, ())
    whole, resumed = tmp_path / "whole.npz", tmp_path / "resumed.npz"
    assert replay(deployment, frames, whole, in_this_process)[0] == 12
    # those of a sequence are computed in order, whatever the way
    is_sequence = deployment.filter is not None or deployment.machine.rng_reset == "free"
    if is_sequence:
        stopping = 0

        def advance():
            nonlocal stopping
            stopping += 1
            if stopping == 5:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            replay(deployment, frames, resumed, backwards, advance=advance)
    else:
        with pytest.raises(KeyboardInterrupt):
            replay(deployment, frames, resumed, stop_after_five)
    assert not resumed.exists()
    ran, run_on = [], replays._run_on

    def noting_rows(*given):
        run = run_on(*given)
        return lambda row, *rest: (ran.append(row), run(row, *rest))[1]

    monkeypatch.setattr(replays, "_run_on", noting_rows)
    computed, without = replay(deployment, frames, resumed, backwards)
    first = 0 if deployment.machine.rng_reset == "free" else 5
    assert sorted(ran) == [row for row in range(first, 12) if frames.fits[row]]
    assert computed == (12 if deployment.machine.rng_reset == "free" else 7)
    assert resumed.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob("*.frames"))
    with np.load(whole) as arrays:
        assert arrays["probabilities"].shape == (12, *(each.size for each in deployment.searched))
        has_none = np.isnan(arrays["probabilities"]).any(axis=tuple(range(1, arrays["probabilities"].ndim)))
        assert (has_none >= ~frames.fits).all()
        assert has_none.sum() == without < 12
        assert (arrays["frame"][frames.fits] == np.arange(1, frames.fits.sum() + 1)).all()
        assert (arrays["frame"] == -1).sum() == (~frames.fits).sum()
        assert arrays["probabilities"][~has_none].reshape(-1, deployment.machine.lines).sum(
            axis=1
        ) == pytest.approx(1)


@pytest.mark.parametrize("name", ["posteriors.npz", "posteriors.mcap"])
def test_the_output_grows_while_frames_are_computed(tmp_path, name):
    build_model(corridor(), tmp_path / "deployment", partitions=2)
    deployment = load_deployment(tmp_path / "deployment")
    rows = [f"{at % 11},{at % 2}" for at in range(2000)]
    (tmp_path / "recording.csv").write_text("\n".join(["range,loud", *rows]) + "\n")
    frames = recorded_frames(tmp_path / "recording.csv", deployment.variables, ())
    whole, mixed, sizes = tmp_path / f"whole-{name}", tmp_path / name, []
    partial = whole.with_name(f"{whole.name}.part")

    def note_size():
        sizes.append(partial.stat().st_size if partial.exists() else 0)

    replay(deployment, frames, whole, in_this_process, advance=note_size)
    if name.endswith(".npz"):  # the library of bags keeps a chunk of them in memory
        assert sizes[0] < sizes[1000] < sizes[-1]

    records = {}

    def in_parts(job, numbers, keep):
        def note(row, record):
            records[row] = record
            keep(row, record)

        for part in (1, 0, 2):
            backwards(job, numbers[part::3], note)

    replay(deployment, frames, mixed, in_parts)
    assert mixed.read_bytes() == whole.read_bytes()
    if name.endswith(".npz"):
        expected = np.frombuffer(b"".join(records[row] for row in range(2000)), record_layout(deployment))
        with np.load(mixed) as arrays:
            assert (arrays["cycles"] == expected["cycles"]).all()
            found = arrays["probabilities"].reshape(2000, -1)
            assert np.array_equal(found, expected["posterior"], equal_nan=True)


@pytest.mark.parametrize(
    ("rows", "stamps"),
    [
        ("range,loud\n3,1\n5,0\n", [0, 1]),
        ("range,loud,stamp_ns\n3,1,1795348800099417765\n5,0, 0\n", [1795348800099417765, 0]),
        ("time_s,range,loud\n1252437312.101,3,1\n1e3,5,0\n", [1252437312101000000, 10**12]),
    ],
)
def test_stamps_of_a_csv_file(tmp_path, rows, stamps):
    build_model(corridor(), tmp_path / "corridor")
    deployment = load_deployment(tmp_path / "corridor")
    (tmp_path / "r.csv").write_text(rows)
    frames = recorded_frames(tmp_path / "r.csv", deployment.variables, ())
    assert frames.stamps.tolist() == stamps


@pytest.mark.parametrize("stamp", ["", "soon", "-1", "nan", "1e999999999", "9223372037"])
def test_a_wrong_stamp_is_named(tmp_path, stamp):
    build_model(corridor(), tmp_path / "corridor")
    (tmp_path / "r.csv").write_text(f"range,loud,time_s\n3,1,7\n5,0,{stamp}\n")
    output = tmp_path / "p.npz"
    result = toolchain("infer", tmp_path / "r.csv", "-d", tmp_path / "corridor", "-o", output)
    assert_refused(result, "r.csv, line 3: time_s is", f"{stamp!r}, expected a time")


def test_the_bytes_of_a_bag_do_not_depend_on_its_name(tmp_path):
    build_model(corridor(), tmp_path / "corridor")
    (tmp_path / "r.csv").write_text("range,loud\n3,1\n5,0\n")
    deployment = load_deployment(tmp_path / "corridor")
    frames = recorded_frames(tmp_path / "r.csv", deployment.variables, ())
    for name in ("first.mcap", "second.mcap"):
        replay(deployment, frames, tmp_path / name, in_this_process)
    content = (tmp_path / "first.mcap").read_bytes()
    assert (tmp_path / "second.mcap").read_bytes() == content
    assert b"first" not in content


def test_the_command_writes_a_bag_that_rosbags_reads(tmp_path):
    from rosbags.highlevel import AnyReader

    build_model(corridor(), tmp_path / "corridor")
    (tmp_path / "r.csv").write_text("range,loud\n3,1\n,0\n5,0\n")
    for name in ("posteriors.npz", "posteriors.mcap"):
        result = done(
            toolchain("infer", tmp_path / "r.csv", "-d", tmp_path / "corridor", "-o", tmp_path / name)
        )
        assert "1 rows have no posterior because they do not fit: row 1: " in result.stderr
        assert "3 frames, 1 without a posterior" in result.stderr
    with AnyReader([tmp_path / "posteriors.mcap"]) as reader:
        found = [
            (stamp, reader.deserialize(raw, connection.msgtype).data.tolist())
            for connection, stamp, raw in reader.messages()
        ]
    with np.load(tmp_path / "posteriors.npz") as arrays:
        assert found == [(at, arrays["probabilities"][at].tolist()) for at in (0, 2)]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "corridor",
        "posteriors.mcap",
        "posteriors.npz",
        "r.csv",
    ]


@pytest.mark.parametrize(
    ("recording", "output", "named"),
    [
        ("range\n3\n", "p.npz", ("r.csv has no column 'loud'",)),
        ("range,loud\nx,no\n", "p.npz", ("has no row that fits this machine: row 0: ",)),
        ("range,loud\n3,1\n", "p.txt", ("must end with .npz or .mcap",)),
        ("range,loud\n3,1\n", "none/p.npz", ("is not a folder; create it first",)),
        ("range,loud\n3,1\n", "folder.npz", ("folder.npz is a folder; name a file",)),
    ],
)
def test_what_cannot_be_inferred_is_one_sentence(tmp_path, recording, output, named):
    build_model(corridor(), tmp_path / "corridor")
    (tmp_path / "r.csv").write_text(recording)
    (tmp_path / "folder.npz").mkdir()
    result = toolchain("infer", tmp_path / "r.csv", "-d", tmp_path / "corridor", "-o", tmp_path / output)
    assert_refused(result, *named)


def record(value):
    found = np.zeros((), LAYOUT)
    found["posterior"] = value
    found["crc"] = crc32(found.tobytes()[8:])
    return found.tobytes()


def test_a_part_file_keeps_whole_records_alone(tmp_path):
    path = tmp_path / "p.frames"

    def opened():
        return PartFile.opened(path, "key", LAYOUT, 4)

    with suppress(KeyboardInterrupt), opened() as part:
        assert part.there == b"\0\0\0\0"
        for row in (3, 0, 1):
            part.add(row, record(row))
        assert part.there == b"\1\1\0\1"
        with pytest.raises(BuildError, match="another run is writing .*frames"), opened():
            pass
        raise KeyboardInterrupt
    content = path.read_bytes()
    path.write_bytes(content[:-9])  # torn at its end
    with suppress(KeyboardInterrupt), opened() as part:
        assert part.there == b"\1\1\0\0"
        assert part.records["posterior"].tolist()[:2] == [[0, 0, 0], [1, 1, 1]]
        part.add(2, record(np.nan))
        raise KeyboardInterrupt
    with path.open("r+b") as file:  # a damaged record
        file.seek(len(content) - 3 * LAYOUT.itemsize - 1)
        file.write(b"\x55")
    with opened() as part:
        assert part.there == b"\0\1\1\0"
    assert not path.exists()


@pytest.mark.parametrize("content", [b"x", b"rosbayes infer other\n", b"rosbayes infer ke\n"])
def test_a_part_file_of_other_work_is_refused(tmp_path, content):
    path = tmp_path / "p.frames"
    path.write_bytes(content)
    refused = pytest.raises(
        BuildError, match="belongs to another recording, deployment or version; delete it"
    )
    with refused, PartFile.opened(path, "key", LAYOUT, 4):
        pass
    assert path.read_bytes() == content


def test_a_pipe_is_no_part_file(tmp_path):
    os.mkfifo(tmp_path / "p.frames")
    refused = pytest.raises(BuildError, match="frames cannot be written: Illegal seek$")
    with refused, PartFile.opened(tmp_path / "p.frames", "key", LAYOUT, 4):
        pass


def test_a_full_disk_is_noticed_before_the_work(tmp_path):
    refused = pytest.raises(BuildError, match="cannot be written: ")
    with refused, PartFile.opened(tmp_path / "p.frames", "key", LAYOUT, 1 << 50):
        pass
