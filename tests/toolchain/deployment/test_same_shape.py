"""The shape of a deployment: permitted changes in a run, and errors that name the others with both values."""

import pytest

from tests.toolchain.deployments import boat
from toolchain.deployment import Deployment, MachineSection, Output, Queue, Source, Variable, WrittenPrior
from toolchain.deployment.same_shape import differences

(SOURCE,), BOARDS, (Y, X) = boat().sources, boat().boards, boat().searched
D1 = Variable(name="D1", bits=7, values=101)
B1 = Variable(name="B1", bits=7, values=100)
ROOM = Variable(name="room", kind="prior_select", bits=2, values=3)
MACHINE = MachineSection(lines=12, prior_bits=2, prior_mode="written")


def deployment(**fields):
    return boat(**({"variables": (D1, B1, ROOM), "machine": MACHINE} | fields))


def changed(section, **fields):
    return type(section)(**(dict(section) | fields))


@pytest.mark.parametrize(
    "fields",
    [
        {"name": "boat, mended", "hash": "0" * 64, "tolerance_s": 0.2},
        {"boards": tuple(changed(each, image="b.bm", image_hash="f" * 64) for each in BOARDS)},
        {"machine": changed(MACHINE, target_count=100, max_cycles=4096, stop="own", scale="column")},
        {"variables": (B1, D1, ROOM)},
        {"variables": (changed(D1, offset=1.0, step=0.5, values=90, path="d.one"), B1, ROOM)},
        {"variables": (changed(D1, on_range="clamp", on_missing="missing"), B1, ROOM)},
        {"searched": (changed(Y, offset=5.0, step=2.0), changed(X, states=("a", "b", "c")))},
        {"prior": WrittenPrior(path="prior")},
    ],
)
def test_what_may_change(fields):
    assert differences(deployment(), deployment(**fields)) == []
    assert differences(deployment(**fields), deployment()) == []


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"queue": Queue.ALL}, "queue"),
        ({"sources": (changed(SOURCE, compression="cbor"),)}, "[[source]] 0 compression"),
        ({"sources": (SOURCE, changed(SOURCE, topic="/b"))}, "[[source]] number"),
        ({"variables": (D1, ROOM)}, "[[variable]] names"),
        ({"variables": (changed(D1, bits=8), B1, ROOM)}, "[[variable]] bits of column 1"),
        ({"variables": (changed(B1, bits=9), D1, ROOM)}, "[[variable]] bits of column 1"),
        ({"searched": (changed(Y, label="z"), X)}, "[[searched]] 0 label"),
        ({"searched": (Y, changed(X, size=4))}, "[[searched]] 1 size"),
        ({"boards": (changed(BOARDS[0], endpoint="unix:/b"), BOARDS[1])}, "[[board]] 0 endpoint"),
        ({"boards": (changed(BOARDS[0], lines=12),)}, "[[board]] number"),
        ({"machine": changed(MACHINE, prob_bits=10)}, "[machine] prob_bits"),
    ],
)
def test_what_may_not_change_is_named(fields, field):
    found = differences(deployment(), Deployment.model_construct(**(dict(deployment()) | fields)))
    assert [each.field for each in found] == [field]


def test_a_difference_is_one_sentence_with_both_values():
    (found,) = differences(deployment(), deployment(outputs=(Output(uri="ws://b:1"),)))
    assert str(found).startswith("[[output]] 0 uri is empty in the run and ws://b:1 in")


def test_every_field_is_decided():
    """A field that is added to a section is one of the shape, unless it is said to be free."""
    for section, table in ((MachineSection, "machine"), (Source, "sources"), (Output, "outputs")):
        before = deployment()
        inside = getattr(before, table)
        one = inside if table == "machine" else inside[0]
        unnoticed = set()
        for name in section.model_fields:
            other = one.model_copy(update={name: "something else"})
            after = before.model_copy(update={table: other if table == "machine" else (other,)})
            if not differences(before, after):
                unnoticed.add(name)
        assert unnoticed == ({"scale", "target_count", "max_cycles", "stop"} if table == "machine" else set())
