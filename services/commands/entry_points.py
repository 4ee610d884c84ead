"""The commands' entry points: Ctrl-C while a command still loads ends it without a traceback.

Loading takes tenths of a second. Until a command has its own handlers nothing is open, so the signal may do its worst.
"""

from __future__ import annotations

import signal
from importlib import import_module


def _run(module: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    command = import_module(f"services.{module}").main
    signal.signal(signal.SIGINT, signal.default_int_handler)
    command()


def master() -> None:
    """`master`."""
    _run("commands.master")


def subscriber() -> None:
    """`subscriber`."""
    _run("pipeline.subscriber")


def publisher() -> None:
    """`publisher`."""
    _run("pipeline.publisher")


def pcie_app() -> None:
    """`pcie-app`."""
    _run("pipeline.pcie_app")


def board() -> None:
    """`board`."""
    _run("commands.board")


def loader() -> None:
    """`loader`."""
    _run("commands.loader")


def hub() -> None:
    """`hub`."""
    _run("commands.hub")


def status() -> None:
    """`status`."""
    _run("commands.status")


def discover() -> None:
    """`discover`."""
    _run("commands.discover")


def listen() -> None:
    """`listen`."""
    _run("commands.listen")
