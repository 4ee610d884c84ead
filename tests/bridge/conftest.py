"""The client must live on either event loop: every asynchronous test of it runs on both, on uvloop with `--all`."""

import asyncio

import uvloop


def pytest_asyncio_loop_factories():
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
