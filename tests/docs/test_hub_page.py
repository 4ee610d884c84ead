"""docs/how-to/hub.md: every limit and every service of rosapi is described."""

import dataclasses
from pathlib import Path

from bridge.hub.limits import HubLimits
from tests.bridge.hub.broker_harness import Harness

PAGE = (Path(__file__).parents[2] / "docs/how-to/hub.md").read_text()


def test_every_limit_is_described():
    for field in dataclasses.fields(HubLimits):
        assert f"`{field.name}`" in PAGE


def test_every_service_is_described():
    services = Harness().connect().rosapi("node_details", node="/rosapi")["services"]
    assert services
    for service in services:
        assert f"`{service.removeprefix('/rosapi/')}`" in PAGE
