"""Flags and the build options that they become."""

from dataclasses import asdict, fields

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from toolchain.building.options import BuildOptions, MachineOptions, TargetOptions
from toolchain.commands.request import BuildFlags, build_options
from toolchain.deployment import Queue, Scale, Stop

MACHINE = {
    "partitions": 2,
    "scale": Scale.NONE,
    "prob_bits": 9,
    "prior_mode": PriorMode.WRITTEN,
    "counter_bits": 10,
    "target_count": 11,
    "max_cycles": 12,
    "stop": Stop.OWN,
    "rng": RngKind.LFSR24,
    "rng_banks": 13,
    "rng_reset": RngReset.FREE,
    "shared": False,
    "steps_per_clock": 14,
    "sensor_mode": SensorMode.CELL,
    "replicas": 15,
}
TARGET = TargetOptions(
    uri="ws://a:1", topic="/b", type="c/D", output="/e", prior_path="f", queue=Queue.ALL, tolerance_s=0.7
)


def test_every_flag_reaches_the_options():
    assert {field.name for field in fields(MachineOptions)} == set(MACHINE)
    given = MACHINE | asdict(TARGET)
    options = build_options(BuildFlags(**MACHINE), TARGET)
    assert {name: getattr(options, name) for name in given} == given
    defaults = BuildOptions(uri="ws://a:2", topic="/c", type="d/D")
    assert not [name for name, value in given.items() if getattr(defaults, name) == value]
