"""Files that a run leaves behind: found out at its start whether they can be, and numbers written at its end."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path

from casestudies.errors import OutputError


def check_writable(folder: Path) -> None:
    """Make a folder if it isn't there, and find out before a long run that nothing can be written into it.

    Raises:
        OutputError: the folder refuses, or is none.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written into: {error.strerror or error}; name another folder"
        ) from None


def write_numbers(path: Path, numbers: Mapping[str, object]) -> None:
    """Write numbers as one JSON object.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(numbers, indent=1) + "\n")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from None
