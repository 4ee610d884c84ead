"""Writing of `deployment.toml`: the same deployment gives the same bytes."""

from pathlib import Path
from typing import Any, Final

import tomli_w

from toolchain.deployment.deployment import Deployment, DeploymentFile
from toolchain.deployment.deployment_hash import with_hash
from toolchain.errors import DeploymentError
from toolchain.files.whole_file import whole_file

_HEADER: Final = """\
# Written by `toolchain build`. URIs and endpoints may be changed here; the rest belongs to the boards' images
# and is guarded by the hash: change the model and build again.
"""


def write_deployment(directory: Path, deployment: Deployment) -> Deployment:
    """Write `deployment.toml` with its hash atomically, and return the written deployment."""
    written = with_hash(deployment.replace(directory=Path(directory)))
    with whole_file(written.path, DeploymentError) as partial:
        partial.write_text(deployment_text(written), encoding="utf-8")
    return written


def deployment_text(deployment: DeploymentFile) -> str:
    """Return the text of `deployment.toml`: the same deployment gives the same bytes."""
    content: dict[str, Any] = deployment.model_dump(mode="json", exclude_none=True)
    aliases = {name: field.validation_alias for name, field in type(deployment).model_fields.items()}
    plain = {key: value for key, value in content.items() if not isinstance(value, list | dict)}
    parts = [_HEADER + tomli_w.dumps(plain)]
    for key, value in content.items():
        heading = str(aliases[key] or key)
        if isinstance(value, dict):
            parts.append(f"[{heading}]\n" + tomli_w.dumps(value))
        elif isinstance(value, list):
            parts.extend(f"[[{heading}]]\n" + tomli_w.dumps(item) for item in value)
    return "\n".join(parts)
