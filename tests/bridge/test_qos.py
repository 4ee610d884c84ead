import math

import pytest

from bridge.errors import OptionError
from bridge.qos import Qos


def test_only_given_options_are_requested():
    assert Qos().as_operation() == {}
    assert Qos(
        history="keep_last",
        depth=5,
        reliability="best_effort",
        durability="transient_local",
        deadline=1.25,
        lifespan=math.inf,
    ).as_operation() == {
        "history": "keep_last",
        "depth": 5,
        "reliability": "best_effort",
        "durability": "transient_local",
        "deadline": {"secs": 1, "nsecs": 250_000_000},
        "lifespan": "infinite",
    }


@pytest.mark.parametrize(
    "wrong",
    [
        {"history": "all"},
        {"reliability": "RELIABLE"},
        {"durability": 1},
        {"depth": -1},
        {"depth": 1.0},
        {"depth": True},
        {"deadline": -1},
        {"deadline": math.nan},
        {"lifespan": True},
    ],
)
def test_what_servers_would_refuse_is_refused_here(wrong):
    with pytest.raises(OptionError, match=f"qos {next(iter(wrong))}"):
        Qos(**wrong)
