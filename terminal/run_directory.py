"""The run directory: the sockets of a run's processes.

    $XDG_RUNTIME_DIR/rosbayes, otherwise /tmp/rosbayes-UID    unless BM_RUN_DIRECTORY or --run-directory names one
        master.status.sock  subscriber.sock  board0.sock  ...

Only this user can enter the default directory. A master that starts processes locks the run directory with flock. Child
processes inherit the lock. The kernel releases the lock when master and child processes have ended, even after a kill.
The next start replaces the sockets of killed processes.
"""

import contextlib
import fcntl
import os
import socket
import stat
import tempfile
from pathlib import Path

from terminal.errors import ExitCode, OutputError
from terminal.health import SUFFIX
from terminal.output import warn

_LONGEST_RUNTIME = 40
"""Maximum length of XDG_RUNTIME_DIR in bytes, because the path of a socket has at most 107."""


class OccupiedError(Exception):
    """Another run locks the run directory. The other run may already be ending."""

    exit_code = ExitCode.USAGE


def default_run_directory() -> Path:
    """Return the path of this user's default run directory. The directory may not exist."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    # the specification requires ignoring relative paths
    usable = Path(runtime).is_absolute() and len(os.fsencode(runtime)) < _LONGEST_RUNTIME
    if usable and os.access(f"{runtime}/.", os.W_OK | os.X_OK):
        return Path(runtime, "rosbayes")
    return Path(tempfile.gettempdir(), f"rosbayes-{os.geteuid()}")


def run_directory(given: Path | None) -> Path:
    """Return the run directory `given`. If `given` is None, create and return this user's default run directory.

    Raises an OutputError if the default directory cannot be created, or is not a private directory of this user.
    """
    if given is not None:
        return given.absolute()
    path = default_run_directory()
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise OutputError(
            f"the run directory {path} cannot be created: {error.strerror or error}; name another one with BM_RUN_DIRECTORY"
        ) from error
    # in a folder for all, another user may have created it
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise OutputError(
            f"{path} is not a private directory of this user (mode 700); remove it, or name another one with BM_RUN_DIRECTORY"
        )
    return path


def status_directory(given: Path | None, name: str) -> Path | None:
    """Return the run directory of a process without a master, or warn and return None if the folder is unusable."""
    try:
        return run_directory(given)
    except OutputError as error:
        warn(f"its status cannot be shown: {error}", name=name)
        return None


class LockedRunDirectory:
    """The run directory of a master that starts processes.

    The directory is locked until `release` is called and all children of the master have ended.
    """

    def __init__(self, given: Path | None) -> None:
        """Lock the directory.

        Raises:
            OccupiedError: Another run uses the directory.
            OutputError: The path is not a folder and cannot be created, or other users can enter the folder.
        """
        self.path = run_directory(given)
        """The absolute path of the directory."""
        with contextlib.suppress(OSError):  # whoever may not create it cannot open it either
            self.path.mkdir(mode=0o700)
        # the descriptor of the lock, which children inherit
        try:
            self.lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise OutputError(
                f"BM_RUN_DIRECTORY: {self.path} is not a folder, and cannot be created ({error.strerror}); name another one"
            ) from error
        try:
            self._claim()
        except BaseException:
            os.close(self.lock)
            raise
        remove_stale_sockets(self.path)

    def _claim(self) -> None:
        if os.fstat(self.lock).st_mode & 0o077:
            raise OutputError(
                f"{self.path} can be entered by other users, who could reach or replace the sockets in it: run chmod 700 {self.path}"
            )
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OccupiedError(
                f"another run uses {self.path}; stop it, or name another folder with --run-directory DIR"
            ) from error

    def release(self) -> None:
        """Remove the sockets that killed processes left, and unlock the directory."""
        remove_stale_sockets(self.path)
        os.close(self.lock)


def remove_stale_sockets(directory: Path) -> None:
    """Remove the status sockets of killed processes."""
    for path in directory.glob(f"*{SUFFIX}"):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(0.2)
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()
