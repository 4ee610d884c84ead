"""Finding rosbridge servers by name on the local network: multicast DNS, as Bonjour and Avahi speak it.

A server announces itself as an instance of the service ``_rosbridge._tcp.local.``, under the robot's name, with what
a client must know in its properties: ``path`` of the URL, ``tls``, ``token`` and ``ros`` (1 or 2). All of them may be
missing, so that a line in Avahi's configuration announces a rosbridge server that knows nothing of this.

``zeroconf`` is an extra (``pip install zeroconf``), imported when one of these functions is called.
What comes from the network is anybody's: it is bounded, and fit to be printed.

Source: RFC 6762 and 6763.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from bridge.errors import BridgeError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from zeroconf.asyncio import AsyncServiceInfo, AsyncZeroconf

SERVICE_TYPE: Final = "_rosbridge._tcp.local."
#: Robots that are told of at most; a network with more than this is no robots' network.
MAX_ROBOTS: Final = 256
#: Bytes of a name at most (RFC 6763, section 4.1.1).
_LONGEST_NAME: Final = 63
_PATH: Final = re.compile(r"/[A-Za-z0-9._~/-]{0,200}")
_HOST: Final = re.compile(r"[A-Za-z0-9.-]{1,253}")
_LAST_PORT: Final = 65535
#: Seconds within which who has a name already says so.
_TAKEN_TIME: Final = 3.0


class DiscoveryError(BridgeError):
    """Raised when robots cannot be looked for, or announced; without ``zeroconf``, or without a network."""

    exit_code: ClassVar[int] = 2


class UnknownRobotError(BridgeError):
    """Raised when nobody of a name announces a rosbridge server."""


@dataclass(frozen=True, slots=True)
class Robot:
    """A rosbridge server that announced itself.

    Attributes:
        name: of the robot.
        uri: of the server.
        ros_version: which ROS it speaks for, None if it does not say.
        token: whether it wants one.
    """

    name: str
    uri: str
    ros_version: Literal[1, 2] | None = None
    token: bool = False


async def discover(
    timeout: float = 2.0,  # noqa: ASYNC109  # all of it is used, and no error
    *,
    interfaces: Sequence[str] | None = None,
) -> list[Robot]:
    """Look for rosbridge servers.

    Args:
        timeout: seconds to wait for answers; nobody says when all have come.
        interfaces: addresses of this machine's to ask at; None asks at all.

    Returns:
        Those that answered, by name.

    Raises:
        DiscoveryError: ``zeroconf`` is not installed, or there is no network to ask.
    """
    from_name: dict[str, Robot] = {}
    async with _zeroconf(interfaces) as zeroconf:
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


async def resolve(
    name: str,
    timeout: float = 5.0,  # noqa: ASYNC109  # part of the error
    *,
    interfaces: Sequence[str] | None = None,
) -> str:
    """The URI of the rosbridge server that a robot announces.

    Args:
        name: the robot's.
        timeout: seconds to wait for its answer.
        interfaces: addresses of this machine's to ask at; None asks at all.

    Raises:
        UnknownRobotError: nobody of that name answers in time.
        DiscoveryError: ``zeroconf`` is not installed, there is no network to ask, or no robot has such a name.
    """
    _check_name(name)
    async with _zeroconf(interfaces) as zeroconf:
        robot = await _ask(zeroconf, f"{name}.{SERVICE_TYPE}", timeout)
    if robot is None:
        raise UnknownRobotError(
            f"no robot called {name} announced a rosbridge server within {timeout:g} s: `discover` lists those that "
            "do, and ws://HOST:PORT reaches one that does not"
        )
    return robot.uri


@asynccontextmanager
async def announced(
    name: str,
    host: str,
    port: int,
    *,
    ros_version: Literal[1, 2] | None = None,
    tls: bool = False,
    token: bool = False,
    interfaces: Sequence[str] | None = None,
) -> AsyncIterator[None]:
    """Announce a rosbridge server as long as the context is open.

    Args:
        name: the robot's, unique on the network.
        host: the address that the server listens on; ``0.0.0.0`` and ``::`` are all of this machine's. One of
            loopback is announced to this machine alone.
        port: of the server.
        ros_version: which ROS it speaks for.
        tls: whether it wants TLS; its clients are sent to this machine's own name then, which its certificate
            must bear.
        token: whether it wants one.
        interfaces: addresses of this machine's to answer at; None answers at all.

    Raises:
        DiscoveryError: ``zeroconf`` is not installed, there is no network, or another server has the name.
    """
    _check_name(name)
    addresses = _addresses(host, interfaces)
    if interfaces is None and all(ipaddress.ip_address(address).is_loopback for address in addresses):
        interfaces = ("127.0.0.1",)  # nobody else on the network reaches it
    async with _zeroconf(interfaces) as zeroconf:
        from zeroconf.asyncio import AsyncServiceInfo

        if await _ask(zeroconf, f"{name}.{SERVICE_TYPE}", _TAKEN_TIME) is not None:
            raise DiscoveryError(
                f"another rosbridge server on this network is called {name} already: choose another name"
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
        await (await zeroconf.async_register_service(info, cooperating_responders=True))
        try:
            yield
        finally:
            await (await zeroconf.async_unregister_service(info))


def _check_name(name: str) -> None:
    size = len(name.encode("utf-8", "replace"))
    if not 1 <= size <= _LONGEST_NAME or not name.isprintable() or "." in name:
        raise DiscoveryError(
            f"{name[:_LONGEST_NAME]!r} cannot be the name of a robot: 1 to {_LONGEST_NAME} letters, digits, spaces and "
            "the like make one, without dots"
        )


def _addresses(host: str, interfaces: Sequence[str] | None) -> list[str]:
    """The addresses that a server on ``host`` is reached at."""
    if interfaces is not None:
        return list(interfaces)
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return sorted({str(info[4][0]) for info in socket.getaddrinfo(host, None)})
    if not address.is_unspecified:
        return [str(address)]
    import ifaddr  # zeroconf's own dependency

    every = [ip.ip for adapter in ifaddr.get_adapters() for ip in adapter.ips if isinstance(ip.ip, str)]
    return [each for each in every if not ipaddress.ip_address(each).is_loopback] or ["127.0.0.1"]


@asynccontextmanager
async def _zeroconf(interfaces: Sequence[str] | None) -> AsyncIterator[AsyncZeroconf]:
    try:
        from zeroconf import Error, InterfaceChoice
        from zeroconf.asyncio import AsyncZeroconf
    except ImportError:
        raise DiscoveryError(
            "finding robots by name needs the package zeroconf, which is not installed: pip install zeroconf"
        ) from None
    try:
        zeroconf = AsyncZeroconf(interfaces=InterfaceChoice.All if interfaces is None else list(interfaces))
    except (OSError, Error) as error:
        raise DiscoveryError(
            f"robots cannot be looked for by name here, as there is no network for multicast DNS ({error})"
        ) from None
    try:
        yield zeroconf
    finally:
        await zeroconf.async_close()


async def _ask(zeroconf: AsyncZeroconf, full_name: str, patience: float) -> Robot | None:
    """What a robot says of itself; None if it does not in time, or says nothing of use."""
    from zeroconf import BadTypeInNameException
    from zeroconf.asyncio import AsyncServiceInfo

    try:
        info = AsyncServiceInfo(SERVICE_TYPE, full_name)
    except BadTypeInNameException:
        return None
    return _robot(info) if await info.async_request(zeroconf.zeroconf, patience * 1000) else None


def _robot(info: AsyncServiceInfo) -> Robot | None:
    """A robot of what its server announces; None for what cannot be one."""
    name = info.name.removesuffix(f".{SERVICE_TYPE}")
    properties = info.decoded_properties
    addresses = sorted(info.parsed_addresses(), key=lambda address: (":" in address, address))
    tls = properties.get("tls") == "1"
    # A certificate bears a name, hardly ever an address.
    host = (info.server or "").rstrip(".") if tls else addresses[0] if addresses else ""
    path = properties.get("path") or "/"
    if not name or not name.isprintable() or not host or not 1 <= (info.port or 0) <= _LAST_PORT:
        return None
    if _PATH.fullmatch(path) is None or (tls and _HOST.fullmatch(host) is None):
        return None
    shown = f"[{host}]" if ":" in host else host
    uri = f"{'wss' if tls else 'ws'}://{shown}:{info.port}{path if path != '/' else ''}"
    ros: Literal[1, 2] | None = (
        2 if properties.get("ros") == "2" else 1 if properties.get("ros") == "1" else None
    )
    return Robot(name, uri, ros, properties.get("token") == "1")
