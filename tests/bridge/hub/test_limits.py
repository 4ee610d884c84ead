import dataclasses

import pytest

from bridge.hub.limits import HubError, HubLimits


def test_every_limit_must_be_positive():
    for field in dataclasses.fields(HubLimits):
        with pytest.raises(HubError, match=field.name):
            HubLimits(**{field.name: 0})


def test_limits_that_contradict_each_other_are_refused():
    with pytest.raises(HubError, match="client_bytes"):
        HubLimits(message_bytes=1000, client_bytes=999)
    with pytest.raises(HubError, match="depth"):
        HubLimits(depth=251)
    assert HubError.exit_code == 2
