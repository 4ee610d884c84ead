"""A deployment that is to take the place of the one in force: read, compared in shape, and kept for the run's children."""

from __future__ import annotations

import shutil
import stat
from collections.abc import Callable
from pathlib import Path

from services.errors import NotReloadedError, SettingsError, ShapeError
from services.supervision.private_directory import COPY_PREFIX
from toolchain.deployment import Deployment, load_deployment
from toolchain.deployment.same_shape import differences

_LARGEST_FILE = 1 << 28
_NAMED = 4
"""Differences that a refusal names; the rest it counts."""


def read_new(folder: Path, in_force: Deployment, as_used: Callable[[Deployment], Deployment]) -> Deployment:
    """Read a deployment of the shape of the one in force. Its images are for pcie-app to check.

    Args:
        folder: Where it is.
        in_force: What it is to replace.
        as_used: A deployment as this run uses it: what flags override counts for nothing.

    Raises:
        ToolchainError: It is damaged, of another version, or not there.
        ShapeError: It differs in what has to stay; names the fields.
        SettingsError: The folder can't be reached.
    """
    try:
        loaded = load_deployment(folder, images=False)
    except OSError as error:
        msg = f"{folder} can't be read: {error.strerror or error}"
        raise SettingsError(msg) from error
    found = differences(as_used(in_force), as_used(loaded))
    if found:
        rest = f"; {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        msg = (
            f"{loaded.path} is of another shape: {'; '.join(map(str, found[:_NAMED]))}{rest}. "
            "A run takes other tables, priors, targets and ways to read messages; for this one, end it and start it anew"
        )
        raise ShapeError(msg)
    return loaded


def keep(deployment: Deployment, directory: Path, generation: int) -> Path:
    """Copy what the services read of a deployment, so that a child that is restarted finds it whatever becomes of the folder.

    Args:
        deployment: The deployment.
        directory: The run's own.
        generation: Its number in the run.

    Returns:
        The folder with the copy.

    Raises:
        SettingsError: A file of it is not there, can't be read, or is none.
        NotReloadedError: It can't be copied, or was changed meanwhile.
        ToolchainError: The copy is none.
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
            msg = f"{source} can't be copied to {kept}, for services that are restarted: {error.strerror or error}"
            raise NotReloadedError(msg) from error
    if load_deployment(kept, images=False).hash != deployment.hash:
        msg = f"{deployment.path} was changed while it was read; reload again when that is done"
        raise NotReloadedError(msg)
    return kept


def _check_readable(source: Path) -> None:
    """See that a deployment's file can be copied, before there is a copy to blame.

    Raises:
        SettingsError: It can't, and says why.
    """
    try:
        found = source.stat()
        if stat.S_ISREG(found.st_mode):  # to open a pipe would wait for who writes into it
            source.open("rb").close()
    except OSError as error:
        msg = f"{source} can't be read: {error.strerror or error}"
        raise SettingsError(msg) from error
    if not stat.S_ISREG(found.st_mode) or found.st_size > _LARGEST_FILE:
        msg = f"{source} is no file of at most {_LARGEST_FILE >> 20} MiB: it belongs to no deployment; build it again"
        raise SettingsError(msg)


def forget(directory: Path, generation: int) -> None:
    """Take a copy away that no child reads any more."""
    shutil.rmtree(directory / f"{COPY_PREFIX}{generation}", ignore_errors=True)
