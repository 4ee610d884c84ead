"""Reading of deployments: `deployment.toml`, its hash and its images; errors give file and line."""

from pathlib import Path
from typing import Final

from toolchain.deployment.deployment import FILE_NAME, FORMAT, Deployment, DeploymentFile
from toolchain.deployment.deployment_hash import deployment_hash
from toolchain.errors import DamagedDeploymentError, DeploymentError, DeploymentVersionError
from toolchain.files.toml_file import TomlFile

_FORMER_KEYS: Final = ("integrity", "integrity_frames")
"""Keys that earlier versions wrote or read, and that did not enter the hash."""


def load_deployment(directory: Path, *, images: bool = True, edited: bool = False) -> Deployment:
    """Read and check a deployment.

    Args:
        directory: The folder written by `toolchain build`.
        images: True to read the images and compare their hashes; without them, a process starts without
            NumPy.
        edited: True to accept an edited `deployment.toml`, whose hash does not match its content.

    Raises:
        DeploymentError: The deployment is absent, not TOML, or has a wrong key or value.
        DeploymentVersionError: Another format.
        DamagedDeploymentError: `deployment.toml` or an image has changed since the build; the sentence
            contains the file and both hashes.
    """
    directory = Path(directory)
    path = directory / FILE_NAME
    if directory.is_file():
        raise DeploymentError(
            f"{directory} is a file; give the folder written by 'toolchain build', here perhaps {directory.parent}"
        )
    if not path.is_file():
        raise DeploymentError(
            f"{directory} does not contain a deployment: {path} does not exist; create one with 'toolchain build'"
        )
    toml = TomlFile.read(path, DeploymentError)
    version = toml.tables.get("format")
    if version != FORMAT or isinstance(version, bool):
        found = "has no key 'format'" if version is None else f"is of format {version!r}"
        raise DeploymentVersionError(
            f"{path} {found}, and this version reads format {FORMAT}: build it again with 'toolchain build'"
        )
    for key in _FORMER_KEYS:
        if key in toml.tables:
            raise toml.mistake(
                (key,), f"'{key}' belonged to a check of the boards that was removed; delete this line"
            )
    file = toml.validated(DeploymentFile)
    computed = deployment_hash(file)
    if computed != file.hash and not edited:
        raise DamagedDeploymentError(
            f"{path} is not as it was built: its hash is {computed[:16]}, "
            f"but it names {file.hash[:16] or 'none'}; only URIs, endpoints, compression and topic_bytes may be edited: "
            "build it again with 'toolchain build', or keep the edit with 'toolchain regenerate deployment'"
        )
    deployment = Deployment(**dict(file), directory=directory)
    if images:
        _check_images(deployment)
    return deployment


def _check_images(deployment: Deployment) -> None:
    # Here, not above, because a subscriber loads a deployment without NumPy.
    from pcie_shim.errors import DamagedImageError, PcieShimError
    from pcie_shim.programming_file import read_image

    for index, board in enumerate(deployment.boards):
        path = deployment.image_path(index)
        if not path.is_file():
            raise DamagedDeploymentError(
                f"{path}, the image of board {index}, does not exist: build it again with 'toolchain build'"
            )
        try:
            image = read_image(path)
        except DamagedImageError as reason:
            raise DamagedDeploymentError(str(reason)) from reason
        except PcieShimError as reason:
            raise DeploymentError(str(reason)) from reason
        if image.image_hash != board.image_hash:
            raise DamagedDeploymentError(
                f"{path} is another board's or another build's image: its hash is {image.image_hash[:16]}, "
                f"{deployment.path} names {board.image_hash[:16]}"
            )
