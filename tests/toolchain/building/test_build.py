"""A model built into a deployment: the boards together are the machine, and the same input gives the same bytes."""

import os
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.parameters import RngKind, RngReset
from pcie_shim.programming_file import read_image
from tests.toolchain.builders import interval, normal, wrapped_normal
from tests.toolchain.running import OPTIONS, build_model
from toolchain.building.build import assemble, build_date, build_deployment
from toolchain.building.machine import plan_machine
from toolchain.building.quantise import quantise
from toolchain.deployment import Queue, Scale, Stop, load_deployment
from toolchain.errors import BuildError, DeploymentError, ToolchainError
from toolchain.models.model import Known, Model, cell_centres


def model(size=5, sensors=2):
    y, x = interval("y", 0, 10, cells=size), interval("x", 0, 10, cells=size)
    ys, xs = cell_centres(y, x)
    known = [normal("D", mean=np.hypot(xs, ys), sigma=1.0, values=15, floor=0.05)]
    known += [
        wrapped_normal(f"B{i}", mean=np.arctan2(ys, xs), sigma=0.3, values=20, step=np.pi / 10)
        for i in range(1, sensors)
    ]
    return Model(name="small", searched=(y, x), known=tuple(known))


@pytest.mark.parametrize("partitions", [1, 3, 4, 25])
def test_the_boards_together_are_the_machine(tmp_path, partitions):
    built = build_model(model(), tmp_path, partitions=partitions, prob_bits=7)
    deployment = load_deployment(tmp_path)
    assert deployment == built.deployment
    images = [read_image(deployment.image_path(i)) for i in range(partitions)]
    expected = quantise(model(), prob_bits=7)
    assert np.array_equal(np.hstack([image.machine.prior for image in images]), expected.prior)
    for column, table in enumerate(expected.tables):
        assert np.array_equal(np.hstack([image.machine.tables[column] for image in images]), table)
    for index, (image, board) in enumerate(zip(images, deployment.boards, strict=True)):
        assert image.partition.index == index
        assert (image.partition.count, image.partition.total_lines) == (partitions, 25)
        assert image.partition.line_offset == board.line_offset
        assert image.machine.parameters.lines == board.lines
        assert image.model_hash == images[0].model_hash
    assert len({image.image_hash for image in images}) == partitions


def test_options_arrive_in_the_deployment_and_in_the_images(tmp_path):
    limits = {"target_count": 17, "max_cycles": 999, "stop": Stop.OWN}
    generators = {"rng": RngKind.LFSR16, "rng_banks": 3, "rng_reset": RngReset.FREE}
    machine = {"prob_bits": 5, "counter_bits": 6, **generators}
    frames = {"queue": Queue.ALL, "tolerance_s": 0.2}
    others = {"output": "/where", "interface": (4, 30), "build_date": "2020-02-02T02:02:02Z"}
    options = replace(OPTIONS, scale=Scale.COLUMN, **limits, **machine, **frames, **others)
    deployment = build_deployment(plan_machine(model(), options), tmp_path).deployment
    image = read_image(deployment.image_path(0))
    for section, fields in (
        (deployment.machine, limits | machine | {"interface": "4x30", "steps_per_clock": 8}),
        (image.machine.parameters, machine),
        (deployment, frames),
        (image, {"interface_sensors": 4, "interface_results": 30, "build_date": others["build_date"]}),
    ):
        assert {name: getattr(section, name) for name in fields} == fields
    assert deployment.outputs[0].topic == "/where"
    scaled = quantise(model(), prob_bits=5, scale=Scale.COLUMN)
    assert np.array_equal(image.machine.tables[0], scaled.tables[0])


def test_units_of_readings_change_no_image_and_no_hash():
    plain = assemble(plan_machine(model(), OPTIONS)).deployment
    known = tuple(replace(each, unit="m") for each in model().known)
    with_units = assemble(plan_machine(replace(model(), known=known), OPTIONS)).deployment
    assert {each.unit for each in with_units.variables} == {"m"}
    assert (with_units.hash, with_units.boards) == (plain.hash, plain.boards)


def test_seeds_that_no_memory_holds(tmp_path):
    options = replace(OPTIONS, rng_banks=65536, shared=False)
    with pytest.raises(BuildError, match="9633792 .* 57065, or --shared"):
        build_deployment(plan_machine(model(size=7), options), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_interface_has_the_size_of_the_largest_board_and_says_so(tmp_path):
    built = build_model(model(sensors=21), tmp_path)
    assert built.deployment.machine.interface == "21x25"
    assert "Interface: 21x25, which is the size of the largest board.\n" in built.report
    plan = plan_machine(model(), replace(OPTIONS, partitions=2, interface=(20, 1200)))
    assert assemble(plan).deployment.machine.interface == "20x1200"
    split = assemble(replace(plan, options=replace(plan.options, interface=None)))
    assert split.deployment.machine.interface == "2x13"
    for interface in ((2, 25), (64, 4096)):  # exactly the machine's size, and the register map's
        assemble(plan_machine(model(), replace(OPTIONS, interface=interface)))


@pytest.mark.parametrize(
    "changes",
    [
        {"partitions": 26},
        {"interface": (1, 1200)},
        {"interface": (2, 24)},
        {"interface": (2, 4097)},
        {"prob_bits": 17},
        {"prob_bits": 8, "rng": RngKind.LFSR8},
        {"rng_table": np.arange(4, dtype=np.uint32)},
        {"target_count": 256},
        {"tolerance_s": -1.0},
    ],
)
def test_options_that_do_not_fit(tmp_path, changes):
    with pytest.raises(BuildError) as caught:
        build_model(model(), tmp_path / "new", **changes)
    assert caught.value.exit_code == 2
    assert not (tmp_path / "new").exists()  # nothing is written before all is known to fit


def test_a_model_larger_than_the_register_map(tmp_path):
    flat = Model(
        name="long",
        searched=(interval("x", 0, 1, cells=5000),),
        known=(Known(name="K", table=np.ones((1, 5000))),),
    )
    with pytest.raises(BuildError, match="room for 64 and 4096: use --partitions 2 or more"):
        build_model(flat, tmp_path)
    assert len(build_model(flat, tmp_path, partitions=2).deployment.boards) == 2


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(BuildError, match=rf"^{re.escape(str(folder))} .* -o$"):
            build_model(model(), folder)


def test_a_build_over_another_leaves_nothing_of_it_even_if_it_fails_half_way(tmp_path):
    build_model(model(), tmp_path, partitions=4)
    (tmp_path / "boards" / "notes.txt").write_text("mine")
    build_model(model(), tmp_path, partitions=2)
    assert sorted(p.name for p in (tmp_path / "boards").iterdir()) == ["board0.bm", "board1.bm", "notes.txt"]
    load_deployment(tmp_path)
    (tmp_path / "boards" / "board1.bm").unlink()
    (tmp_path / "boards" / "board1.bm" / "in the way").mkdir(parents=True)
    with pytest.raises(BuildError, match=r"boards/board1\.bm "):
        build_model(model(), tmp_path, partitions=2)
    with pytest.raises(DeploymentError, match="was interrupted; repeat that 'toolchain build'"):
        load_deployment(tmp_path)
    (tmp_path / "boards" / "board1.bm" / "in the way").rmdir()
    (tmp_path / "boards" / "board1.bm").rmdir()
    build_model(model(), tmp_path, partitions=2)
    load_deployment(tmp_path)
    assert sorted(path.name for path in tmp_path.glob("deployment*")) == ["deployment.toml"]


@pytest.mark.parametrize("name", ["report.txt", "boards/board7.bm"])
def test_a_build_leaves_files_alone_that_no_build_wrote(tmp_path, name):
    (tmp_path / "model.py").write_text("mine")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(BuildError, match=rf"has {re.escape(name)}, but no deployment\.toml"):
        build_model(model(), tmp_path)
    assert (tmp_path / name).read_text() == "mine"
    (tmp_path / name).unlink()
    build_model(model(), tmp_path)
    assert (tmp_path / "model.py").read_text() == "mine"


def test_the_report_has_loss_and_warnings(tmp_path):
    known = normal("D", mean=np.arange(40.0), sigma=1.0, values=40, floor=1e-3)
    line = Model(name="line", searched=(interval("x", -0.5, 39.5, cells=40),), known=(known,))
    built = build_model(line, tmp_path)
    assert built.report == (tmp_path / "report.txt").read_text()
    assert "Model line: 40 lines (x 40), 1 known variable, D." in built.report
    assert "Warning: Variable D: its outlier floor" in built.report
    assert f"{built.quantised.losses[1].mass:.2e}" in built.report
    assert str(tmp_path) not in built.report


@given(st.integers(0, 2**33))
def test_the_build_date_is_source_date_epoch_or_the_files(tmp_path_factory, seconds):
    path = tmp_path_factory.mktemp("date") / "model.py"
    path.write_text("")
    os.utime(path, (seconds, seconds))
    from_file = build_date(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", str(seconds))
        os.utime(path, (0, 0))
        assert build_date(path) == from_file
        patch.setenv("SOURCE_DATE_EPOCH", "yesterday")
        with pytest.raises(ToolchainError, match="SOURCE_DATE_EPOCH is 'yesterday'"):
            build_date(path)
