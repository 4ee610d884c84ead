"""The hash that protects a deployment against edits.

It covers everything that follows from the model, but not URIs, endpoints and the like: a deployment remains valid for
another robot, but not after an edit that contradicts its tables.
"""

import hashlib
import json

from toolchain.deployment.deployment import Deployment, DeploymentFile


def deployment_hash(deployment: DeploymentFile) -> str:
    """Return the SHA-256 (hexadecimal) of the part of a deployment that follows from the model."""
    content = deployment.model_dump(
        mode="json",
        exclude={
            "hash": True,
            "sources": {"__all__": {"uri", "compression", "topic_bytes"}},
            "boards": {"__all__": {"endpoint"}},
            "outputs": {"__all__": {"uri"}},
        },
    )
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def with_hash(deployment: Deployment) -> Deployment:
    """Return a deployment with the hash of its content."""
    return deployment.replace(hash=deployment_hash(deployment))
