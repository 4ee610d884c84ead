"""Robots by name, on loopback only, so that others on the network neither see nor disturb these tests."""

import asyncio
import os
import sys
from contextlib import AsyncExitStack
from types import SimpleNamespace

import pytest
import zeroconf.asyncio  # noqa: F401 - here, because it runs ldconfig when it is first imported, to find a library

from bridge import discovery
from bridge.discovery import DiscoveryError, Robot, UnknownRobotError, announced, discover, resolve
from tests.patience import PATIENCE

LOOPBACK = ["127.0.0.1"]
ZEROCONF = discovery._zeroconf


@pytest.fixture(autouse=True)
def loopback_only(monkeypatch):
    """Ask on loopback only, and return the interfaces that were chosen."""
    chosen = []

    def on_loopback(interfaces=None):
        chosen.append(interfaces)
        return ZEROCONF(LOOPBACK)

    monkeypatch.setattr(discovery, "_zeroconf", on_loopback)
    return chosen


def _name(what):
    """A name that no other run of these tests announces at the same time."""
    return f"{what} {os.getpid()}"


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_robot_that_is_announced_is_found_and_then_gone(monkeypatch, loopback_only):
    monkeypatch.setattr(discovery, "_TAKEN_TIME", 0.5)
    name = _name("Röbot")
    with pytest.raises(UnknownRobotError, match=name):
        await resolve(name, 0.1)
    async with announced(name, "127.0.0.1", 9099, ros_version=2, token=True):
        assert loopback_only == [None, LOOPBACK], "others could not reach it"
        assert await resolve(name, PATIENCE) == "ws://127.0.0.1:9099"
        found = []
        async with asyncio.timeout(PATIENCE):
            while not found:
                found = [robot for robot in await discover(1.5) if robot.name == name]
        assert found == [Robot(name, "ws://127.0.0.1:9099", 2, token=True)]


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_name_that_is_taken_is_refused(monkeypatch):
    name = _name("Twin")
    async with AsyncExitStack() as stack:
        monkeypatch.setattr(discovery, "_TAKEN_TIME", 0.5)
        await stack.enter_async_context(announced(name, "127.0.0.1", 9099))
        monkeypatch.setattr(discovery, "_TAKEN_TIME", PATIENCE)
        with pytest.raises(DiscoveryError, match=f"called {name}") as caught:
            await stack.enter_async_context(announced(name, "127.0.0.1", 9100))
        assert caught.value.exit_code == 2


@pytest.mark.parametrize("name", ["", "x" * 64, "ü" * 32, "a.b", "a\nb", "a\x1b[31mb"])
async def test_what_cannot_be_a_name_is_refused(name):
    with pytest.raises(DiscoveryError, match="cannot be the name"):
        await resolve(name, 0.1)
    with pytest.raises(DiscoveryError, match="cannot be the name"):
        async with announced(name, "127.0.0.1", 9099):
            pass


@pytest.mark.parametrize("uri", ["robot:9090", "robot:9090/bridge"])
async def test_a_port_instead_of_a_robots_name_is_refused_with_the_uri_that_was_meant(uri):
    with pytest.raises(DiscoveryError, match=f"ws://{uri}") as caught:
        await discovery.announced_uri(uri)
    assert caught.value.exit_code == 2


async def test_without_zeroconf_one_sentence_says_so(monkeypatch):
    for module in ("zeroconf", "zeroconf.asyncio"):
        monkeypatch.setitem(sys.modules, module, None)
    for attempt in (discover(0.1), resolve("Robot", 0.1)):
        with pytest.raises(DiscoveryError, match=r"pip install zeroconf") as caught:
            await attempt
        assert caught.value.exit_code == 2


# zeroconf leaves the socket that listens when it finds none to send from
@pytest.mark.filterwarnings("ignore:.*socket.socket:pytest.PytestUnraisableExceptionWarning")
async def test_without_a_network_one_sentence_says_so():
    with pytest.raises(DiscoveryError, match="no network"):
        async with ZEROCONF(["192.0.2.77"]):
            pass


def _announced(**properties):
    """Return an announcement as read by zeroconf."""
    said = {
        "name": f"Robot.{discovery.SERVICE_TYPE}",
        "port": 9090,
        "server": "robot.local.",
        "addresses": ["192.0.2.7"],
    } | properties
    addresses = said.pop("addresses")
    txt = {key: said.pop(key) for key in ("path", "tls", "token", "ros") if key in said}
    return SimpleNamespace(**said, decoded_properties=txt, parsed_addresses=lambda: addresses)


@pytest.mark.parametrize(
    ("said", "robot"),
    [
        ({}, Robot("Robot", "ws://192.0.2.7:9090")),
        ({"ros": "1", "path": "/bridge"}, Robot("Robot", "ws://192.0.2.7:9090/bridge", 1)),
        ({"ros": "7", "token": "1"}, Robot("Robot", "ws://192.0.2.7:9090", None, token=True)),
        ({"tls": "1"}, Robot("Robot", "wss://robot.local:9090")),
        ({"addresses": ["fd00::7", "192.0.2.7"]}, Robot("Robot", "ws://192.0.2.7:9090")),
        ({"addresses": ["fd00::7"]}, Robot("Robot", "ws://[fd00::7]:9090")),
        ({"addresses": []}, None),
        ({"port": 0}, None),
        ({"port": None}, None),
        ({"path": "/a b"}, None),
        ({"path": "/\x1b[31m"}, None),
        ({"path": "@evil.example/"}, None),
        ({"tls": "1", "server": "robot local"}, None),
        ({"tls": "1", "server": None}, None),
        ({"name": f"R\x1b[31m.{discovery.SERVICE_TYPE}"}, None),
    ],
)
def test_what_the_network_says_is_checked(said, robot):
    assert discovery._robot(_announced(**said)) == robot


def test_the_addresses_that_are_announced():
    assert discovery._addresses("192.0.2.7") == ["192.0.2.7"]
    assert discovery._addresses("localhost") == ["127.0.0.1"]
    every = discovery._addresses("::")
    assert every
    assert "::" not in every
    assert every == ["127.0.0.1"] or "127.0.0.1" not in every
