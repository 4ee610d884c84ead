"""The command `dashboard`, which serves a page that shows posteriors."""

import asyncio
import os
import socket
import sys
from contextlib import suppress
from importlib.util import find_spec
from typing import Annotated, Final

import typer

from bridge.client.websocket import check_uri
from bridge.hub.access import AccessPolicy, is_loopback
from bridge.names import check_name
from services.commands import flags as options
from services.commands.hub import access_policy
from services.errors import SettingsError
from services.settings import Settings
from services.sockets.reporting import serve_status
from services.sockets.status import ProcessStatus
from terminal.command_line import CommandLine
from terminal.one_line import shown
from terminal.output import say
from terminal.run_directory import default_run_directory, status_directory
from terminal.signals import run_async, until_one_ends
from toolchain.deployment import Deployment

DEFAULT_URI: Final = "ws://127.0.0.1:9090"
TRUTH_TOPIC: Final = "/boat/true_pose"

app = CommandLine(
    help="Show the posteriors of a running stack in a browser.\n\n"
    "`dashboard --uri ws://robot:9090`, then open http://127.0.0.1:8080\n\n"
    "With `-d build/boat`, axes have units; without it, those of the master on this machine are used. "
    "On a non-loopback address it requires TLS and tokens, as `hub` does."
)


@app.command(help=app.info.help)
@options.with_settings("deployment", "uri", "ca", "ros_version", "run_directory", "log_format")
def dashboard(
    settings: Settings,
    topic: options.ResultsTopic = None,
    truth: Annotated[
        str, typer.Option(help="Topic of the true pose (PoseStamped).", metavar="TOPIC")
    ] = TRUTH_TOPIC,
    host: Annotated[str, typer.Option(help="Address to listen on.", metavar="ADDRESS")] = "127.0.0.1",
    # the second name is the flag of master and demo, which pass on an error that names it
    port: Annotated[
        int, typer.Option("--port", "--page-port", min=0, max=65535, help="Port; 0 selects a free one.")
    ] = 8080,
    tls_cert: options.TlsCert = None,
    tls_key: options.TlsKey = None,
    token_file: options.TokenFile = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ORIGIN",
            help="Further address of the page, such as https://robot.example for a proxy; repeat for more.",
        ),
    ] = None,
    insecure: options.Insecure = False,
) -> int:
    """Show the posteriors of a running stack in a browser."""
    if find_spec("nicegui") is None:
        raise SettingsError(
            "the dashboard needs NiceGUI, which is not installed: pip install 'rosbayes[dashboard]'"
        )
    # read before anything listens, as in the hub
    policy = access_policy(
        host,
        (tls_cert, tls_key, token_file),
        origin or [],
        insecure=insecure,
        danger="lets everybody on that network see the posteriors and move the boat",
    )
    deployment, server, results = options.results_of(settings, topic)
    check_uri(uri := server or DEFAULT_URI)
    for name in (results, truth):
        check_name(name)
    with _listening(host, port) as listener:
        return run_async(
            _serve(settings, deployment, listener, policy, host=host, uri=uri, topic=results, truth=truth)
        )


def _listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address, or raise a SettingsError."""
    # before the web framework is imported, which takes a second
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except socket.gaierror as error:
        raise SettingsError(
            f"the dashboard cannot listen on {shown(host)}: that is not an address or name of this machine ({error.strerror})"
        ) from None
    except OSError as error:
        raise SettingsError(
            f"the dashboard cannot listen on {shown(host)} port {port} ({os.strerror(error.errno or 0)}): "
            "end the process that listens there, or choose another --page-port"
        ) from None


async def _serve(
    settings: Settings,
    deployment: Deployment | None,
    listener: socket.socket,
    policy: AccessPolicy,
    *,
    host: str,
    uri: str,
    topic: str,
    truth: str,
) -> int:
    """Serve the page until cancelled."""
    if sys.platform == "linux":
        # A posterior wakes this process in the middle of the hub's sending. It must not preempt the hub, which has
        # other subscribers to serve. If the system refuses the policy, the page only delays the others more.
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    from services.dashboard.feed import Feed
    from services.dashboard.robot import WatchedRobot
    from services.dashboard.server import PageServer

    feed = Feed()
    robot = WatchedRobot(feed, settings, deployment, uri=uri, topic=topic, truth=truth)
    server = PageServer(feed, robot, listener, policy, loopback=is_loopback(host))
    scheme, address = "https" if policy.tls else "http", f"[{host}]" if ":" in host else host
    where = f"{scheme}://{address}:{listener.getsockname()[1]}"

    def status() -> ProcessStatus:
        return ProcessStatus(ready=server.ready.is_set(), why=f"{where}, {robot.state}")

    async def say_where() -> None:
        await server.ready.wait()
        say(f"dashboard: open {where} in a browser")
        await asyncio.Event().wait()

    directory = status_directory(settings.run_directory, "dashboard")
    stack = settings.run_directory or default_run_directory()
    async with serve_status(directory, "dashboard", status):
        await until_one_ends(server.run(), robot.follow(), robot.watch_stack(stack), say_where())
    return 0
