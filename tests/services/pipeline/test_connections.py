"""Connections to a deployment's servers: certificates from the settings, and servers that start later."""

import asyncio
import contextlib

import pytest

from bridge.errors import AccessRefusedError, UnreachableError
from bridge.hub.access import AccessPolicy, tls_context
from services.pipeline.connections import connect_all
from services.settings import Settings
from services.sockets.status import why_not_connected
from tests.bridge.hub.sockets import running_hub
from tests.certificates import issue
from tests.patience import PATIENCE
from tests.services.conftest import until


async def test_a_certificate_that_only_the_settings_know(tmp_path):
    certificate, key = issue(tmp_path, "localhost")
    async with running_hub(access=AccessPolicy(tls=tls_context(certificate, key))) as port:
        uris = [f"wss://localhost:{port}"]
        async with contextlib.AsyncExitStack() as stack:
            by_uri = await connect_all(stack, Settings(ca=certificate), uris)
            assert by_uri[uris[0]].state == "connected"
        async with contextlib.AsyncExitStack() as stack:
            with pytest.raises((AccessRefusedError, UnreachableError)):
                await connect_all(stack, Settings(connect_timeout=0.5), uris)


async def test_a_robot_of_the_deployment_is_looked_up(monkeypatch):
    async with running_hub() as port:

        async def resolve(name):
            assert name == "Robot 7"
            return f"ws://127.0.0.1:{port}"

        monkeypatch.setattr("bridge.discovery.resolve", resolve)
        async with contextlib.AsyncExitStack() as stack:
            by_uri = await connect_all(stack, Settings(), ["robot:Robot 7"])
            assert by_uri["robot:Robot 7"].state == "connected"


async def test_a_server_that_is_waited_for_is_named(unused_tcp_port):
    uri, by_uri = f"ws://127.0.0.1:{unused_tcp_port}", {}
    async with contextlib.AsyncExitStack() as stack:
        connecting = asyncio.create_task(
            connect_all(stack, Settings(connect_timeout=PATIENCE), [uri], by_uri)
        )
        await until(lambda: by_uri and by_uri[uri].last_error)
        assert uri in why_not_connected(by_uri)
        async with running_hub(port=unused_tcp_port):
            await connecting
            assert not why_not_connected(by_uri)
