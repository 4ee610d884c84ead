"""The flags of the scripts; their help has the style of the commands: NUMBER, a|b, [default: 10]."""

import argparse
from pathlib import Path
from typing import Any


def positive(text: str) -> int:
    """Return the value of a flag that is 1 or more."""
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number


_KINDS: dict[Any, str] = {int: "NUMBER", positive: "NUMBER", float: "NUMBER", Path: "FILE"}


class ScriptParser(argparse.ArgumentParser):
    """A parser that adds kinds of values and defaults to the help; `shown` is a default that the code computes."""

    def add_argument(self, *names: str, shown: str = "", **options: Any) -> argparse.Action:
        """Add a flag or an argument; see `argparse`."""
        if options.get("action", "append") == "append" and names[0].startswith("-"):
            kind = "|".join(options.get("choices", ())) or _KINDS.get(options.get("type"), "TEXT")
            options.setdefault("metavar", kind)
            default = options.get("default")
            if text := shown or (f"{default:g}" if isinstance(default, float) else str(default or "")):
                options["help"] = f"{options.get('help', '')} [default: {text}]".strip()
        if "help" in options:
            options["help"] = options["help"].replace("%", "%%")  # argparse formats it
        return super().add_argument(*names, **options)
