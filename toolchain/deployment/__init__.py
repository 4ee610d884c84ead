"""The deployment: everything for the services that follows from the model."""

from toolchain.deployment.deployment import (
    FILE_NAME,
    REPLICA,
    Deployment,
    DeploymentFile,
    deployment_hash,
    deployment_text,
    load_deployment,
    write_deployment,
)
from toolchain.deployment.sections import (
    BoardSection,
    Dimension,
    MachineSection,
    Output,
    Queue,
    Scale,
    Source,
    Stop,
    Variable,
    WrittenPrior,
    parse_interface,
)

__all__ = [
    "FILE_NAME",
    "REPLICA",
    "BoardSection",
    "Deployment",
    "DeploymentFile",
    "Dimension",
    "MachineSection",
    "Output",
    "Queue",
    "Scale",
    "Source",
    "Stop",
    "Variable",
    "WrittenPrior",
    "deployment_hash",
    "deployment_text",
    "load_deployment",
    "parse_interface",
    "write_deployment",
]
