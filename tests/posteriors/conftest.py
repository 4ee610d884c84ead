"""Posteriors must arrive on either event loop."""

from tests.bridge.conftest import pytest_asyncio_loop_factories  # noqa: F401 - a hook of pytest-asyncio
