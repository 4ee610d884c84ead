"""The commands' entry points: Ctrl-C while a command still loads ends it without a traceback.

Loading takes tenths of a second. Until a command has its own handlers nothing is open, so the signal may do its worst.
"""

from __future__ import annotations

import signal
from importlib import import_module


def _run(name: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    command = import_module(f"services.{name}").main
    signal.signal(signal.SIGINT, signal.default_int_handler)
    command()


def master() -> None:
    """`master`."""
    _run("master")


def subscriber() -> None:
    """`subscriber`."""
    _run("subscriber")


def publisher() -> None:
    """`publisher`."""
    _run("publisher")


def pcie_app() -> None:
    """`pcie-app`."""
    _run("pcie_app")


def board() -> None:
    """`board`."""
    _run("board")


def loader() -> None:
    """`loader`."""
    _run("loader")


def hub() -> None:
    """`hub`."""
    _run("hub")


def status() -> None:
    """`status`."""
    _run("status")


def discover() -> None:
    """`discover`."""
    _run("discover")


def listen() -> None:
    """`listen`."""
    _run("listen")
