"""Flags and the build options that they become."""

from dataclasses import fields

from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from toolchain.commands.flags import BuildFlags, ModelFlags
from toolchain.commands.request import build_options
from toolchain.deployment import Scale, Stop

OTHERS = {
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


def test_every_flag_reaches_the_options():
    flags = BuildFlags(**OTHERS)
    options = build_options(flags, uri="ws://a:1", topic="/b", message_type="c/D")
    assert (options.uri, options.topic, options.type) == ("ws://a:1", "/b", "c/D")
    assert {name: getattr(options, name) for name in OTHERS} == OTHERS
    read_elsewhere = {
        "device",
        "interface",
        "bits",
        "rng_table",
        *(field.name for field in fields(ModelFlags)),
    }
    assert {field.name for field in fields(BuildFlags)} == set(OTHERS) | read_elsewhere
    default = build_options(BuildFlags(), uri="ws://a:1", topic="/b", message_type="c/D")
    assert not [name for name, value in OTHERS.items() if getattr(default, name) == value]
