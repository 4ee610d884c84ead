"""Doorbell numbers: how starts and dones are counted, so that none is lost, doubled or mistaken."""

from __future__ import annotations


def following(number: int) -> int:
    """The number after ``number``: one more, modulo 2^32, skipping 0 (which rings nothing)."""
    return number % 0xFFFFFFFF + 1
