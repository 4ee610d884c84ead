"""Discovery of rosbridge servers on the local network by multicast DNS, as in Bonjour and Avahi.

A server announces itself as an instance of the service `_rosbridge._tcp.local.`, under the name of the robot.
The service has the properties `path` of the URL, `tls`, `token` and `ros` (1 or 2). All of them are optional, so a
line in the configuration of Avahi is sufficient to announce a rosbridge server.

The functions import the optional package `zeroconf` (`pip install zeroconf`) when they are called.
Data from the network is not trusted: its amount is limited, and announcements with unprintable names are ignored.

Source: RFC 6762 and 6763.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from bridge.errors import BridgeError

if TYPE_CHECKING:
    from zeroconf.asyncio import AsyncServiceInfo, AsyncZeroconf

SERVICE_TYPE: Final = "_rosbridge._tcp.local."
MAX_ROBOTS: Final = 256
"""Maximum number of listed robots."""
ROBOT: Final = "robot:"
"""Prefix of a URI that names a robot instead of an address."""
_LONGEST_NAME: Final = 63
"""Maximum length of a name in bytes (RFC 6763, section 4.1.1)."""
_PATH: Final = re.compile(r"/[A-Za-z0-9._~/-]{0,200}")
_HOST: Final = re.compile(r"[A-Za-z0-9.-]{1,253}")
_LAST_PORT: Final = 65535
_PORT: Final = re.compile(r"[0-9]+(/.*)?")
"""A port, perhaps with a path: `robot:9090` is a URI without its ws://, and does not name a robot."""
_TIMEOUT: Final = 10.0
"""Default time in seconds in which a robot must answer, the same as `connect_timeout` of `connect`."""
_TAKEN_TIME: Final = 3.0
"""Seconds to wait for an objection from another owner of a name."""
_LOOPBACK: Final = ["127.0.0.1"]


class DiscoveryError(BridgeError):
    """Raised when discovery or an announcement is impossible, for example without `zeroconf` or a network."""

    exit_code: ClassVar[int] = 2


class UnknownRobotError(BridgeError):
    """Raised when no robot of the requested name announces a rosbridge server in time."""


@dataclass(frozen=True, slots=True)
class Robot:
    """An announced rosbridge server.

    Attributes:
        name: Name of the robot.
        uri: URI of the server.
        ros_version: ROS version of the server, or None if the server does not announce a version.
        token: Whether clients need a token.
    """

    name: str
    uri: str
    ros_version: Literal[1, 2] | None = None
    token: bool = False


async def discover(timeout: float = 2.0) -> list[Robot]:
    """Return the rosbridge servers that answer within `timeout` seconds, sorted by name.

    The function always waits for the whole time.

    Raises:
        DiscoveryError: The package `zeroconf` is not installed, or there is no network.
    """
    from_name: dict[str, Robot] = {}
    async with _zeroconf() as zeroconf:
        from zeroconf import ServiceStateChange
        from zeroconf.asyncio import AsyncServiceBrowser

        found: asyncio.Queue[str] = asyncio.Queue(MAX_ROBOTS)

        def on_change(**change: object) -> None:
            if change["state_change"] is ServiceStateChange.Added and not found.full():
                found.put_nowait(str(change["name"]))

        async def ask(full_name: str) -> None:
            robot = await _ask(zeroconf, full_name, timeout)
            if robot is not None:
                from_name[robot.name] = robot

        # The browser finds names; all are asked for their addresses at the same time, because a robot that has just
        # left does not answer.
        browser = AsyncServiceBrowser(zeroconf.zeroconf, SERVICE_TYPE, handlers=[on_change])
        asking: set[asyncio.Task[None]] = set()
        try:
            async with asyncio.timeout(timeout):
                while len(asking) < MAX_ROBOTS:
                    asking.add(asyncio.create_task(ask(await found.get())))
                await asyncio.gather(*asking)
        except TimeoutError:
            pass
        finally:
            for task in asking:
                task.cancel()
            await asyncio.gather(*asking, return_exceptions=True)
            await browser.async_cancel()
    return sorted(from_name.values(), key=lambda robot: robot.name)


async def resolve(name: str, timeout: float = _TIMEOUT) -> str:
    """Return the URI of the rosbridge server of a robot.

    Raises:
        UnknownRobotError: No robot of that name answers in time.
        DiscoveryError: `zeroconf` is not installed, there is no network, or the name is invalid.
    """
    # Asked for directly, which is faster than listing all robots.
    _check_name(name)
    async with _zeroconf() as zeroconf:
        robot = await _ask(zeroconf, f"{name}.{SERVICE_TYPE}", timeout)
    if robot is None:
        raise UnknownRobotError(
            f"no robot called {name} announced a rosbridge server within {timeout:g} s: `discover` lists those that "
            "do, and ws://HOST:PORT reaches one that does not"
        )
    return robot.uri


async def announced_uri(uri: str, timeout: float = _TIMEOUT) -> str:
    """If `uri` is `robot:NAME`, return the result of `resolve` for NAME. Otherwise, return `uri` unchanged."""
    return await resolve(uri.removeprefix(ROBOT), timeout) if uri.startswith(ROBOT) else uri


def find_uri(uri: str, timeout: float = _TIMEOUT) -> str:
    """Return the result of `announced_uri`, for callers outside an event loop."""
    return asyncio.run(announced_uri(uri, timeout)) if uri.startswith(ROBOT) else uri


@asynccontextmanager
async def announced(
    name: str,
    host: str,
    port: int,
    *,
    ros_version: Literal[1, 2] | None = None,
    tls: bool = False,
    token: bool = False,
) -> AsyncIterator[None]:
    """Announce a rosbridge server while the context is open.

    `host` is the address on which the server listens. `0.0.0.0` and `::` stand for all addresses of this machine.
    A loopback address is announced only to this machine.

    With `tls`, clients get the host name of this machine, and the certificate must contain this host name. `token`
    says whether clients need a token.

    Raises:
        DiscoveryError: `zeroconf` is not installed, there is no network, or another server has the name.
    """
    _check_name(name)
    addresses = _addresses(host)
    # A hub on loopback is not announced to a network that cannot reach it.
    is_local = all(ipaddress.ip_address(address).is_loopback for address in addresses)
    async with _zeroconf(_LOOPBACK if is_local else None) as zeroconf:
        from zeroconf.asyncio import AsyncServiceInfo

        # zeroconf would rename this one silently, and clients would look for a name that nobody has.
        if await _ask(zeroconf, f"{name}.{SERVICE_TYPE}", _TAKEN_TIME) is not None:
            raise DiscoveryError(
                f"another rosbridge server on this network is already called {name}: choose another name"
            )
        properties = {"path": "/", "tls": str(int(tls)), "token": str(int(token))}
        if ros_version is not None:
            properties["ros"] = str(ros_version)
        own_name = socket.gethostname().partition(".")[0] or "localhost"
        info = AsyncServiceInfo(
            SERVICE_TYPE,
            f"{name}.{SERVICE_TYPE}",
            port=port,
            properties=properties,
            server=f"{own_name}.local.",
            parsed_addresses=addresses,
        )
        # The machine's own responder (Avahi) answers on the same port, and for the same host name.
        await (await zeroconf.async_register_service(info, cooperating_responders=True))
        try:
            yield
        finally:
            await (await zeroconf.async_unregister_service(info))


def _check_name(name: str) -> None:
    if _PORT.fullmatch(name):
        raise DiscoveryError(
            f"'{ROBOT}{name}' would be a robot called {name}: for a port of the host `robot` write "
            f"ws://{ROBOT}{name}; a robot's name is more than a number"
        )
    size = len(name.encode("utf-8", "replace"))
    if not 1 <= size <= _LONGEST_NAME or not name.isprintable() or "." in name:
        raise DiscoveryError(
            f"{name[:_LONGEST_NAME]!r} cannot be the name of a robot: 1 to {_LONGEST_NAME} letters, digits, spaces and "
            "the like make one, without dots"
        )


def _addresses(host: str) -> list[str]:
    """Return the addresses of a server that listens on `host`."""
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return sorted({str(info[4][0]) for info in socket.getaddrinfo(host, None)})
    # `0.0.0.0` is no address to connect to, so all real ones are announced.
    if not address.is_unspecified:
        return [str(address)]
    import ifaddr  # a dependency of zeroconf

    every = [ip.ip for adapter in ifaddr.get_adapters() for ip in adapter.ips if isinstance(ip.ip, str)]
    return [each for each in every if not ipaddress.ip_address(each).is_loopback] or ["127.0.0.1"]


@asynccontextmanager
async def _zeroconf(interfaces: list[str] | None = None) -> AsyncIterator[AsyncZeroconf]:
    """Open the network interfaces of this machine with these addresses, or all of them."""
    try:
        from zeroconf import Error, InterfaceChoice
        from zeroconf.asyncio import AsyncZeroconf
    except ImportError:
        raise DiscoveryError(
            "finding robots by name needs the package zeroconf, which is not installed: pip install zeroconf"
        ) from None
    try:
        zeroconf = AsyncZeroconf(interfaces=interfaces or InterfaceChoice.All)
    except (OSError, Error) as error:
        raise DiscoveryError(
            f"robots cannot be found by name here, because there is no network for multicast DNS ({error})"
        ) from None
    try:
        yield zeroconf
    finally:
        await zeroconf.async_close()


async def _ask(zeroconf: AsyncZeroconf, full_name: str, patience: float) -> Robot | None:
    """Query a robot. Return the robot, or None if no usable answer arrives within `patience` seconds."""
    from zeroconf import BadTypeInNameException
    from zeroconf.asyncio import AsyncServiceInfo

    try:
        info = AsyncServiceInfo(SERVICE_TYPE, full_name)
    except BadTypeInNameException:
        return None
    return _robot(info) if await info.async_request(zeroconf.zeroconf, patience * 1000) else None


def _robot(info: AsyncServiceInfo) -> Robot | None:
    """Return the robot in an announcement; None if the announcement is unusable."""
    name = info.name.removesuffix(f".{SERVICE_TYPE}")
    properties = info.decoded_properties
    # IPv4 first: robots announce link-local addresses of IPv6 too, which need a zone.
    addresses = sorted(info.parsed_addresses(), key=lambda address: (":" in address, address))
    tls = properties.get("tls") == "1"
    # A certificate contains a name, rarely an address.
    host = (info.server or "").rstrip(".") if tls else addresses[0] if addresses else ""
    path = properties.get("path") or "/"
    # Anybody on the network may announce anything, so nothing unprintable may reach logs or a request.
    if not name or not name.isprintable() or not host or not 1 <= (info.port or 0) <= _LAST_PORT:
        return None
    if _PATH.fullmatch(path) is None or (tls and _HOST.fullmatch(host) is None):
        return None
    shown = f"[{host}]" if ":" in host else host
    uri = f"{'wss' if tls else 'ws'}://{shown}:{info.port}{path if path != '/' else ''}"
    versions: dict[str | None, Literal[1, 2]] = {"1": 1, "2": 2}
    return Robot(name, uri, versions.get(properties.get("ros")), properties.get("token") == "1")
