"""The private directory of a run: the sockets of its processes.

A process without a master and without BM_RUN_DIRECTORY, such as a hub, has one of its own.
"""

import contextlib
import fcntl
import os
import re
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from terminal.errors import OutputError
from terminal.health import SUFFIX
from terminal.output import say

DIRECTORY_PREFIX = "rosbayes-"

_DIRECTORY_NAME = re.compile(DIRECTORY_PREFIX + "[a-z0-9_]{8}")
_MOST_ORPHANS = 100


class PrivateDirectory:
    """A directory that only this user can enter, and that remains locked while its master is alive.

    The kernel releases the lock when the master exits, even by SIGKILL, so other processes can recognise an
    orphan.
    """

    def __init__(self) -> None:
        """Create and lock a directory, after removing orphans; an OutputError if that is impossible."""
        remove_orphans()
        while True:
            self.path = make_private_directory()
            # before it is locked, another starting master may consider it an orphan
            with contextlib.suppress(FileNotFoundError):
                self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                fcntl.flock(self._lock, fcntl.LOCK_EX)
                if os.fstat(self._lock).st_nlink:
                    return
                os.close(self._lock)

    def remove(self) -> None:
        """Remove the directory and everything in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


@contextlib.contextmanager
def own_directory(given: Path | None, name: str) -> Iterator[Path | None]:
    """Yield the run directory of a process without a master: the given one, or a private one within the context.

    Yield None, after a warning, if none can be created: this must not end the process.
    """
    if given is not None:
        yield given
        return
    try:
        private = PrivateDirectory()
    except OutputError as error:
        say(f"{name}: warning: its status cannot be shown: {error}")
        yield None
        return
    try:
        yield private.path
    finally:
        private.remove()


def _parent() -> Path:
    """Return the folder of the private directories of this user's runs."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    # the specification requires ignoring relative paths; a long path leaves no room for socket names
    usable = Path(runtime).is_absolute() and len(os.fsencode(runtime)) < 40
    return Path(runtime if usable and os.access(f"{runtime}/.", os.W_OK | os.X_OK) else tempfile.gettempdir())


def make_private_directory() -> Path:
    """Create a directory that only this user can enter (0700), or raise an OutputError."""
    try:
        return Path(tempfile.mkdtemp(prefix=DIRECTORY_PREFIX, dir=_parent()))
    except OSError as error:
        raise OutputError(
            f"cannot create a private directory for the local sockets: {error.strerror or error}; set TMPDIR to a writable folder"
        ) from error


def remove_orphans() -> None:
    """Remove private directories orphaned by killed masters.

    An orphan has the right name, belongs only to this user, is not locked by a master, and contains only
    sockets. Links are not followed.
    """
    with contextlib.suppress(OSError):
        found = [each for each in _parent().iterdir() if _DIRECTORY_NAME.fullmatch(each.name)]
        for directory in found[:_MOST_ORPHANS]:
            with contextlib.suppress(OSError):
                _remove_if_orphaned(directory)


def _remove_if_orphaned(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(handle)
        if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) != 0o700:
            return
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with os.scandir(handle) as entries:
            modes = {each.name: each.stat(follow_symlinks=False).st_mode for each in entries}
        if not all(stat.S_ISSOCK(mode) for mode in modes.values()):
            return
        for name in modes:
            os.unlink(name, dir_fd=handle)
        directory.rmdir()
    finally:
        os.close(handle)


def remove_stale_sockets(directory: Path) -> None:
    """Remove the status sockets of killed processes."""
    for path in list(directory.glob(f"*{SUFFIX}")):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(0.2)
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()
