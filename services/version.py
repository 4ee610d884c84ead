"""The version that every greeting carries."""

from __future__ import annotations

from importlib.metadata import version

VERSION = version("rosbayes")
