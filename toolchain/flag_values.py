"""Parsers for values of flags: KEY=VALUE, or comma-separated names."""

from collections.abc import Iterable

from toolchain.errors import BuildError


def key_values(settings: Iterable[str], flag: str = "--set", example: str = "width=64") -> dict[str, str]:
    """Return the values of a flag by key; a BuildError for a missing `=` or key, or a duplicate key."""
    found: dict[str, str] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        key = key.strip()
        if not equals or not key:
            raise BuildError(f"{flag} {setting}: expected KEY=VALUE, such as {flag} {example}")
        if key in found:
            raise BuildError(f"{flag} {key} is given twice")
        found[key] = value
    return found


def names_in(flag: str, text: str) -> list[str]:
    """Return the names in `A,B,C`; a BuildError if one is empty."""
    names = [name.strip() for name in text.split(",")] if text else []
    if not all(names):
        raise BuildError(f"{flag} {text}: expected comma-separated names, such as {flag} A,B")
    return names
