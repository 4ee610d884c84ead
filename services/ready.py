"""The health check of a container, with the readiness of a process as the exit code.

The check imports only a small part of the standard library, because it runs every few seconds.
"""

import os
import sys

from terminal.health import NoHealthError, is_ready, status_socket

_TIMEOUT = 2.0
_USAGE = "usage: python -m services.ready NAME [--run-directory DIR]"


def main(arguments: list[str]) -> int:
    """Return 0 if the process is ready, otherwise 1. Usage errors also give 1, because container engines reserve 2."""
    directory = os.environ.get("BM_RUN_DIRECTORY", "")
    # by hand: typer takes ten times as long to import as the check itself
    names: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        if argument == "--run-directory":
            directory = next(rest, "")
        elif argument.startswith("--run-directory="):
            directory = argument.removeprefix("--run-directory=")
        elif argument in {"-h", "--help"}:
            print(_USAGE)
            return 0
        else:
            names.append(argument)
    if len(names) != 1 or names[0].startswith("-") or "/" in names[0]:
        print(f"{_USAGE}; NAME is master, subscriber, publisher, pcie-app, hub or board0, board1, ...")
        return 1
    if not directory:
        print("no run directory was given: set BM_RUN_DIRECTORY, or give --run-directory DIR")
        return 1
    (name,) = names
    # one sentence in any case: a container engine keeps it as the log of the check
    try:
        ready, why = is_ready(status_socket(directory, name), _TIMEOUT)
    except NoHealthError as error:
        print(f"{name} {error}")
        return 1
    print(f"{name}: {why}")
    return 0 if ready else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
