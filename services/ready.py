"""Whether a process is ready, as an exit code: what a container's health check asks.

Only the standard library is used, and little of it: a health check runs every few seconds.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time

_TIMEOUT = 2.0
_LIMIT = 1 << 20
_USAGE = "usage: python -m services.ready NAME [--directory DIR]"


def ask(directory: str, name: str, timeout: float = _TIMEOUT) -> tuple[bool, str]:
    """Whether the process is ready, and a sentence that says why.

    Args:
        directory: the run directory, where the status sockets are.
        name: the process's, for example "subscriber" or "board0".
        timeout: seconds for the whole answer.
    """
    path = os.path.join(directory, f"{name}.status.sock")  # noqa: PTH118 - pathlib takes as long as all the rest
    deadline = time.monotonic() + timeout
    data = bytearray()
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asked:
            asked.settimeout(timeout)
            asked.connect(path)
            while len(data) <= _LIMIT:
                asked.settimeout(max(0.001, deadline - time.monotonic()))
                part = asked.recv(65536)
                if not part:
                    break
                data += part
    except TimeoutError:
        return False, f"{name} does not answer at {path} within {timeout:g} s"
    except OSError as error:
        return False, f"{name} is not running, or shows no status at {path} ({error.strerror or error})"
    try:
        status = json.loads(data)
        return status["ready"] is True, f"{name}: {status['why']}"
    except (ValueError, TypeError, KeyError, RecursionError):
        return False, f"what answers at {path} is no process of rosbayes"


def main(arguments: list[str]) -> int:
    """Exit code 0: ready; 1: not, or not asked rightly (container engines keep 2 for themselves)."""
    directory = os.environ.get("BM_RUN_DIRECTORY", "")
    names: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        if argument == "--directory":
            directory = next(rest, "")
        elif argument.startswith("--directory="):
            directory = argument.removeprefix("--directory=")
        elif argument in {"-h", "--help"}:
            print(_USAGE)
            return 0
        else:
            names.append(argument)
    if len(names) != 1 or names[0].startswith("-") or "/" in names[0]:
        print(f"{_USAGE}; NAME is master, subscriber, publisher, pcie-app, hub or board0, board1, ...")
        return 1
    if not directory:
        print("no run directory: set BM_RUN_DIRECTORY, or give --directory DIR")
        return 1
    ready, why = ask(directory, names[0])
    print(why)
    return 0 if ready else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
