"""Targets of scripts/fuzz, run with generated input and every input that ever failed (findings/)."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scripts.fuzzing.targets import TARGETS

FINDINGS = sorted((Path(__file__).parent / "findings").glob("*"))

json_like = st.recursive(
    st.sampled_from(
        [
            "null",
            "1",
            "-1.5e300",
            "1e999",
            '"a"',
            "NaN",
            "-Infinity",
            "true",
            "[]",
            "{}",
            "18446744073709551616",
        ]
    ),
    lambda inner: (
        st.lists(inner, max_size=3).map(lambda parts: f"[{','.join(parts)}]")
        | inner.map(lambda part: f'{{"a":{part}}}')
    ),
    max_leaves=8,
).map(str.encode)


@pytest.mark.parametrize("target", TARGETS)
@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=400) | json_like)
def test_any_input_is_taken(target, data):
    TARGETS[target](data)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=24)), max_size=40))
def test_any_sequence_keeps_the_cores_invariants(steps):
    TARGETS["core"](b"\x00" + b"".join(bytes([step]) + rest for step, rest in steps))


@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: path.name)
def test_earlier_findings_pass(path):
    """The name's first part is the target's."""
    TARGETS[path.name.split("-")[0]](path.read_bytes())
