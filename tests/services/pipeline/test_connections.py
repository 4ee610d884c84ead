"""Connections to a deployment's servers: certificates from the settings, and servers that start later."""

import contextlib

import pytest

from bridge.errors import AccessRefusedError, UnreachableError
from bridge.hub.access import AccessPolicy, tls_context
from services.pipeline.connections import connect_all
from services.settings import Settings
from tests.bridge.hub.sockets import running_hub
from tests.certificates import issue


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
