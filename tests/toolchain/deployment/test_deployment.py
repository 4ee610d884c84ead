"""deployment.toml: written and read back, guarded by its hash, and every mistake named with its line.

build ──▶ deployment.toml ──▶ (a user edits it) ──▶ load_deployment ──▶ services
          boards/*.bm                              └─ one sentence: file, line, nearest right name
"""

import hashlib
import re
import string

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from machines.parameters import Sequencer
from tests.toolchain.builders import boat, corridor
from tests.toolchain.running import build_model
from toolchain.deployment import (
    BM1Section,
    BM2Section,
    BoardSection,
    Dimension,
    Output,
    Queue,
    Stop,
    Variable,
    deployment_hash,
    deployment_text,
    load_deployment,
)
from toolchain.deployment.deployment import with_hash
from toolchain.deployment.sections import MESSAGE_PATH
from toolchain.errors import DamagedDeploymentError, DeploymentError, DeploymentVersionError


def write_deployment(folder, deployment):
    written = with_hash(deployment.replace(directory=folder))
    written.path.write_text(deployment_text(written), encoding="utf-8")
    return written


@pytest.fixture
def folder(tmp_path):
    write_deployment(tmp_path, boat())
    return tmp_path


def edit(folder, old, new, *, count=1):
    path = folder / "deployment.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def refused(folder, error=DeploymentError, place=..., line=...):
    with pytest.raises(error) as caught:
        load_deployment(folder, images=False)
    assert caught.value.exit_code == 2
    assert line in {..., caught.value.line}
    assert place in {..., caught.value.place}
    sentence, path = str(caught.value), str(folder / "deployment.toml")
    assert "\n" not in sentence
    assert path in sentence
    return sentence.removeprefix(path)


def test_what_a_deployment_says_of_itself(folder):
    written = load_deployment(folder, images=False)
    assert written == boat(hash=deployment_hash(boat()), directory=folder)
    assert written.image_path(1) == folder / "boards" / "board1.bm"
    assert written.output_uri(Output()) == "ws://a:9090"
    assert (written.machine.interface_sensors, written.machine.interface_results) == (20, 1200)
    assert [written.searched[0].value(i) for i in (0, 3)] == [-3.0, 3.0]


NAMES = st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Z"), include_characters=" "),
    min_size=1,
    max_size=20,
)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def deployments(draw):
    sizes = draw(st.lists(st.integers(1, 5), min_size=1, max_size=3))
    lines = int(np.prod(sizes))
    cuts = sorted(draw(st.sets(st.integers(1, lines - 1), max_size=3))) if lines > 1 else []
    starts = [0, *cuts]
    names = draw(st.lists(NAMES, unique=True, max_size=4))
    step = FLOATS.filter(bool)
    return boat(
        name=draw(NAMES),
        queue=draw(st.sampled_from(list(Queue))),
        tolerance_s=draw(st.floats(0, 86_400)),
        searched=tuple(
            Dimension(label=string.ascii_letters[i], size=size, offset=draw(FLOATS), step=draw(step))
            for i, size in enumerate(sizes)
        ),
        variables=tuple(
            Variable(
                name=name,
                path=draw(st.just("") | st.from_regex(MESSAGE_PATH, fullmatch=True)),
                bits=10,
                values=draw(st.integers(1, 1023)),
                period=draw(st.none() | st.integers(1, 1023)),
                offset=draw(FLOATS),
                step=draw(step),
                on_missing=draw(st.sampled_from(["error", "missing"])),
            )
            for name in names
        ),
        machine=BM1Section(lines=lines, stop=draw(st.sampled_from(list(Stop)))),
        boards=tuple(
            BoardSection(image=f"boards/{i}.bm", image_hash="a" * 64, line_offset=start, lines=end - start)
            for i, (start, end) in enumerate(zip(starts, [*cuts, lines], strict=True))
        ),
    )


@given(deployments())
def test_any_deployment_survives_the_file(tmp_path_factory, deployment):
    folder = tmp_path_factory.mktemp("deployment")
    written = write_deployment(folder, deployment)
    assert load_deployment(folder, images=False) == written
    assert deployment_text(written) == (folder / "deployment.toml").read_text(encoding="utf-8")


def test_the_bytes_of_a_bm1_are_those_of_earlier_versions():
    assert deployment_hash(boat()) == "33f1481aff21fa4f75077d6736ba5b4195f0aae19e807ac2f0991e92d8dc1dd9"
    text = deployment_text(boat())
    assert (
        hashlib.sha256(text.encode()).hexdigest()
        == "ac020ecb68d213ceb4322b7221b628db9098b01de5f9a4792b67c351514ddc3b"
    )


def test_a_section_without_a_type_is_that_of_a_bm1(folder):
    written = load_deployment(folder, images=False)
    edit(folder, 'type = "BM1"\n', "")
    assert load_deployment(folder, images=False) == written


CHAINS = tuple(
    BoardSection(image=f"boards/board{at}.bm", image_hash="a" * 64, line_offset=at, lines=1) for at in (0, 1)
)


def test_a_bm2_has_a_section_of_its_own(tmp_path):
    machine = BM2Section(lines=12, sequencer=Sequencer.COLOURED, stream=4)
    written = write_deployment(tmp_path, boat(machine=machine, boards=CHAINS))
    read = load_deployment(tmp_path, images=False)
    assert read == written
    assert read.machine == machine
    # what services ask of every machine
    assert (read.machine.replicas, read.machine.results, read.machine.is_plain) == (1, 12, True)
    assert (read.machine.reads_lines, read.machine.stop, read.machine.prior_mode) == (False, "own", "table")
    assert read.result_dimensions == boat().searched
    assert read.reading_shape(read.variables[0]) == ()
    assert read.machine_addresses((7, None)) == ((7, None), 0)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('sequencer = "linear"', 'sequencer = "liner"', 56, "did you mean 'linear'?"),
        ("burn_in", "burn_out", 59, "unknown key 'burn_out' in [machine]; did you mean 'burn_in'?"),
        ("burn_in = 1000", "counter_bits = 8", 59, "unknown key 'counter_bits' in [machine]"),
        ('"BM2"', '"BM3"', 52, "type = 'BM3' in [machine] is not a valid value; did you mean 'BM2'?"),
        (
            "line_offset = 1\nlines = 1",
            "line_offset = 1\nlines = 2",
            None,
            "every board of this machine has lines = 1",
        ),
    ],
)
def test_a_mistake_in_the_section_of_a_bm2_is_named_with_its_line(tmp_path, old, new, line, words):
    write_deployment(tmp_path, boat(machine=BM2Section(lines=12), boards=CHAINS))
    edit(tmp_path, old, new)
    assert words in refused(tmp_path, line=line)


def test_uris_and_endpoints_may_be_edited(folder):
    before = load_deployment(folder, images=False)
    edit(folder, "ws://a:9090", "wss://robot.local:443/bridge")
    edit(folder, 'endpoint = ""', 'endpoint = "tcp://board0:7000"')
    edit(folder, 'uri = ""', 'uri = "robot:Robot 7"')
    after = load_deployment(folder, images=False)
    assert after.hash == before.hash
    assert after.sources[0].uri == "wss://robot.local:443/bridge"
    assert after.boards[0].endpoint == "tcp://board0:7000"
    assert after.output_uri(after.outputs[0]) == "robot:Robot 7"


def test_topics_for_tools_are_not_part_of_the_hash(folder):
    before = load_deployment(folder, images=False)
    path = folder / "deployment.toml"
    path.write_text(path.read_text() + "\n[topics]\npose = false\n")
    after = load_deployment(folder, images=False)
    assert after.hash == before.hash
    assert (after.topics.pose, after.topics.counts, before.topics.pose) == (False, None, None)
    assert write_deployment(folder, after) == load_deployment(folder, images=False) == after
    edit(folder, "pose = false", "poses = false")
    assert "did you mean 'pose'?" in refused(folder)


@pytest.mark.parametrize(
    ("key", "value", "heading"),
    [("topics", "3", "[topics]"), ("hidden", "[3]", "[[hidden]]"), ("hidden", "3", "a list")],
)
def test_what_should_be_a_table_is_named_in_our_words(folder, key, value, heading):
    path = folder / "deployment.toml"
    path.write_text(f"{key} = {value}\n{path.read_text()}")
    sentence = refused(folder, line=1)
    assert heading in sentence
    assert not {"valid", "dictionary", "instance", "tuple"} & set(sentence.split())


def test_units_of_readings_are_not_part_of_the_hash(folder):
    before = load_deployment(folder, images=False)
    edit(folder, 'name = "D1"\n', 'name = "D1"\nunit = "m"\n')
    after = load_deployment(folder, images=False)
    assert after.hash == before.hash
    assert [each.unit for each in after.variables] == ["m", ""]
    assert write_deployment(folder, after) == load_deployment(folder, images=False) == after
    for wrong in ('"m\\u001b[2J"', f'"{"m" * 201}"', "3"):
        edit(folder, 'unit = "m"', f"unit = {wrong}")
        refused(folder, place=("variable", 0, "unit"))
        edit(folder, f"unit = {wrong}", 'unit = "m"')


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("offset = 0.0", "offset = 0.5"),
        ('topic = "/boat/sensors"', 'topic = "/boat/sensor"'),
        ('image_hash = "0', 'image_hash = "1'),
        ("hash = ", "# hash = "),
    ],
)
def test_any_other_edit_is_found(folder, old, new):
    edit(folder, "lines = 6\n", "lines = 6\n\n# no change\n")
    load_deployment(folder, images=False)
    edit(folder, old, new)
    assert deployment_hash(boat())[:16] in refused(folder, DamagedDeploymentError)


@pytest.mark.parametrize("new", ["format = true", "format = 7\nwarp = true", ""])
def test_another_format_is_reported_before_anything_else(folder, new):
    edit(folder, "format = 1\n", new + "\n")
    refused(folder, DeploymentVersionError)


def test_a_key_of_a_check_that_was_taken_out_is_to_be_deleted(folder):
    edit(folder, "\nname =", '\nintegrity = "off"\nname =')
    assert "line 4: 'integrity' belonged" in refused(folder)
    assert "delete this line" in refused(folder)


@pytest.mark.parametrize(
    ("old", "new", "line", "place"),
    [
        ("on_range", "on_rnage", 23, ("variable", 0, "on_rnage")),
        ("\nname =", "\nnmae =", 4, ("nmae",)),
        ("[machine]", "[mahcine]", 51, ("mahcine",)),
        ('"clamp"', '"clmp"', 23, ("variable", 0, "on_range")),
        ("bits = 9", 'bits = "9"', 31, ("variable", 1, "bits")),
        ("bits = 9", "bits = 17", 31, ("variable", 1, "bits")),
        ("bits = 9\n", "", 26, ("variable", 1, "bits")),
        ('path = "bearings[0]"', 'path = "bearings[0"', 29, ("variable", 1, "path")),
        ("values = 360", "values = 512", 26, ("variable", 1)),
        ("ws://a:9090", "http://a:9090", 10, ("source", 0, "uri")),
        ("ws://a:9090", "ws://[::1", 10, ("source", 0, "uri")),
        ("max_cycles = 131072", f"max_cycles = {2**63}", 65, ("machine", "max_cycles")),
        ("boat_msgs/Sensors", "Sensors", 12, ("source", 0, "type")),
        ("step = 2.0", "step = 0.0", 43, ("searched", 0, "step")),
        ("target_count = 255", "target_count = 256", 51, ("machine",)),
        ("20x1200", "20 by 1200", 54, ("machine", "interface")),
        ("boards/board1.bm", "../board1.bm", 76, ("board", 1, "image")),
        ("[[variable]]", "[[variable", 14, ()),
        ("tolerance_s = 0.05", "tolerance_s = -1", 7, ("tolerance_s",)),
    ],
)
def test_a_wrong_key_or_value_has_its_line(folder, old, new, line, place):
    edit(folder, old, new)
    refused(folder, place=place, line=line)


@pytest.mark.parametrize(
    ("old", "new", "advice"),
    [
        ("on_range", "on_rnage", r"\[\[variable\]\] 1; .*'on_range'\?$"),
        ("prob_bits", "zzzz", r"\[machine\]; .* type, lines, interface"),
        ('"slices"', '"slice"', r"\[machine\] .*; .*'slices'\?$"),
    ],
)
def test_the_advice_is_the_nearest_right_name(folder, old, new, advice):
    edit(folder, old, new)
    assert re.search(advice, refused(folder))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("source = 0", "source = 1"),
        ("size = 3", "size = 2"),
        ("line_offset = 6", "line_offset = 5"),
        ("line_offset = 6\nlines = 6", "line_offset = 6\nlines = 5"),
        ('name = "B1"', 'name = "D1"'),
    ],
)
def test_parts_that_disagree(folder, old, new):
    edit(folder, old, new)
    with pytest.raises(DeploymentError) as caught:
        load_deployment(folder, images=False, edited=True)
    assert caught.value.place == ()


def test_no_deployment(tmp_path):
    with pytest.raises(DeploymentError, match="deployment.toml"):
        load_deployment(tmp_path / "nowhere")
    file = tmp_path / "deployment.toml"
    file.write_text("")
    with pytest.raises(DeploymentError, match=rf"is a file; give the folder .* {re.escape(str(tmp_path))}"):
        load_deployment(file)


@given(st.binary(max_size=200))
@example(b"\xff\xfe")
@example(b"a = 1\n\nb = [")
@example(b"#" * (5 << 20))
def test_no_bytes_get_past(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("garbage")
    (folder / "deployment.toml").write_bytes(content)
    refused(folder)


def test_objects_are_checked_like_files():
    with pytest.raises(ValidationError, match="expected 0"):
        boat(boards=(BoardSection(image="b.bm", image_hash="0" * 64, line_offset=1, lines=11),))


@pytest.fixture
def with_images(tmp_path):
    build_model(corridor(4), tmp_path, partitions=2)
    return tmp_path


@pytest.mark.parametrize(
    "damage",
    [
        lambda first, second: second.write_bytes(second.read_bytes()[:-1] + b"x"),
        lambda first, second: second.write_bytes(first.read_bytes()),
        lambda first, second: second.unlink(),
    ],
    ids=["damaged", "swapped", "absent"],
)
def test_a_wrong_image_is_named(with_images, damage):
    load_deployment(with_images)
    damage(*(with_images / "boards" / f"board{at}.bm" for at in (0, 1)))
    with pytest.raises(DamagedDeploymentError, match=r"board1\.bm"):
        load_deployment(with_images)
