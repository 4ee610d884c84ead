"""The flags of the scripts; their help has the style of the commands: NUMBER, a|b, [default: 10]."""

import argparse
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


_KINDS: dict[Any, str] = {int: "NUMBER", float: "NUMBER", Path: "FILE"}


class ScriptParser(argparse.ArgumentParser):
    """A parser that adds kinds of values and defaults to the help; `shown` is a default that the code computes."""

    def add_argument(self, *names: str, shown: str = "", **options: Any) -> argparse.Action:
        """Add a flag or an argument; see `argparse`."""
        if options.get("action", "append") == "append" and names[0].startswith("-"):
            kind = "|".join(options.get("choices", ())) or _KINDS.get(options.get("type"), "TEXT")
            options.setdefault("metavar", kind)
            if default := shown or _text(options.get("default")):
                options["help"] = f"{options.get('help', '')} [default: {default}]".strip()
        return super().add_argument(*names, **options)


def _text(default: Any) -> str:
    if isinstance(default, float):
        return f"{default:g}"
    if isinstance(default, Path):
        return str(default.relative_to(ROOT) if default.is_relative_to(ROOT) else default)
    return "" if default is None else ", ".join(default) if isinstance(default, list) else str(default)
