"""The flags of the scripts, with help in the style of the commands: NUMBER, a|b, [default: 10]."""

import argparse
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, NoReturn

from scripts.running.script import reporting_errors, run_script


def positive(text: str) -> int:
    """Return the value of a flag as an integer, which must be 1 or more."""
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number


_KINDS: dict[Any, str] = {int: "NUMBER", positive: "NUMBER", float: "NUMBER", Path: "FILE"}


class ScriptParser(argparse.ArgumentParser):
    """A parser whose help shows the first line of `description`, and the kind and default of each value."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(prog, description=description.splitlines()[0])

    def add_argument(self, *names: str, shown: str = "", **options: Any) -> argparse.Action:
        """Add a flag or an argument as argparse does. If `shown` is given, the help shows this text as the default."""
        if options.get("action", "append") == "append" and names[0].startswith("-"):
            kind = "|".join(options.get("choices", ())) or _KINDS.get(options.get("type"), "TEXT")
            options.setdefault("metavar", kind)
            default = options.get("default")
            if text := shown or (f"{default:g}" if isinstance(default, float) else str(default or "")):
                options["help"] = f"{options.get('help', '')} [default: {text}]".strip()
        if "help" in options:
            options["help"] = options["help"].replace("%", "%%")  # argparse formats it
        return super().add_argument(*names, **options)

    def flag(self, name: str, text: str, default: Any = None, **options: Any) -> None:
        """Add a flag. Values have the type of `default`, or are text if there is none. An integer must be 1 or more."""
        kind = positive if isinstance(default, int) else str if default is None else type(default)
        self.add_argument(name, **{"help": text, "default": default, "type": kind, **options})

    def switch(self, name: str, text: str) -> None:
        """Add a flag without a value."""
        self.add_argument(name, action="store_true", help=text)

    def run(self, work: Callable[[argparse.Namespace], Awaitable[int]], limit: float) -> NoReturn:
        """Parse the flags, call `work` with them, run its coroutine for at most `limit` seconds, and exit."""
        arguments = self.parse_args()
        sys.exit(run_script(lambda: work(arguments), limit))

    def run_at_once(self, work: Callable[[argparse.Namespace], int]) -> NoReturn:
        """Parse the flags, pass them to a function, and exit with what it returns."""
        arguments = self.parse_args()
        sys.exit(reporting_errors(lambda: work(arguments)))
