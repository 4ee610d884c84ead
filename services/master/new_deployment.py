"""Reading a new deployment, comparing its shape with the one in force, and copying it for the run's children."""

import shutil
import stat
from collections.abc import Callable
from pathlib import Path

from services.errors import NotReloadedError, SettingsError, ShapeError
from terminal.private_directory import COPY_PREFIX
from toolchain.deployment import Deployment, load_deployment
from toolchain.deployment.same_shape import differences

_LARGEST_FILE = 1 << 28
_NAMED = 4
"""Maximum number of differences listed in an error; the rest is counted."""


def read_new(folder: Path, in_force: Deployment, as_used: Callable[[Deployment], Deployment]) -> Deployment:
    """Read a deployment of the same shape as the one in force; pcie-app checks its images.

    `as_used` returns a deployment without the fields that flags of this run override.

    Raises:
        ToolchainError: It is damaged, of another version, or missing.
        ShapeError: It differs in fields that a run cannot change.
        SettingsError: The folder is not accessible.
    """
    try:
        loaded = load_deployment(folder, images=False)
    except OSError as error:
        raise SettingsError(f"{folder} cannot be read: {error.strerror or error}") from error
    found = differences(as_used(in_force), as_used(loaded))
    if found:
        rest = f"; {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        other = "other connections" if all(each.is_connection for each in found) else "another shape"
        raise ShapeError(
            f"{loaded.path} has {other}: {'; '.join(map(str, found[:_NAMED]))}{rest}. "
            "A reload can change tables, priors, targets and the reading of messages; for this, restart the run"
        )
    return loaded


def keep(deployment: Deployment, directory: Path, generation: int) -> Path:
    """Copy the files that services read into the run directory, and return the folder of the copy.

    A restarted child reads the copy, so it does not depend on the original folder.

    Raises:
        SettingsError: A file is missing, cannot be read, or is not a regular file.
        NotReloadedError: The files cannot be copied, or were changed meanwhile.
        ToolchainError: The copy is not a deployment.
    """
    kept = directory / f"{COPY_PREFIX}{generation}"
    shutil.rmtree(kept, ignore_errors=True)
    for source in (deployment.path, *(deployment.image_path(at) for at in range(len(deployment.boards)))):
        copy = kept / source.relative_to(deployment.directory)
        _check_readable(source)
        try:
            copy.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            shutil.copyfile(source, copy)
        except OSError as error:
            raise NotReloadedError(
                f"{source} cannot be copied to {kept}, for services that are restarted: {error.strerror or error}"
            ) from error
    if load_deployment(kept, images=False).hash != deployment.hash:
        raise NotReloadedError(
            f"{deployment.path} was changed while it was read; reload again when the change is complete"
        )
    return kept


def _check_readable(source: Path) -> None:
    """Raise a SettingsError for a file that cannot be read, is not a regular file, or is too large."""
    try:
        found = source.stat()
        if stat.S_ISREG(found.st_mode):  # opening a pipe would wait for a writer
            source.open("rb").close()
    except OSError as error:
        raise SettingsError(f"{source} cannot be read: {error.strerror or error}") from error
    if not stat.S_ISREG(found.st_mode) or found.st_size > _LARGEST_FILE:
        raise SettingsError(
            f"{source} is not a file of at most {_LARGEST_FILE >> 20} MiB, like those of a deployment; build it again"
        )


def forget(directory: Path, generation: int) -> None:
    """Remove a copy that children no longer read."""
    shutil.rmtree(directory / f"{COPY_PREFIX}{generation}", ignore_errors=True)
