"""The posterior of a deployment for given readings, computed in this process: for notebooks and tests of models."""

import time
from collections.abc import Mapping
from pathlib import Path

from posteriors.errors import LabelError, PosteriorError
from posteriors.posterior import Posterior
from toolchain.bounded_files import nearest_name
from toolchain.deployment import Variable, load_deployment


def posterior(folder: str | Path, readings: Mapping[str, object], *, bank: int = 0) -> Posterior:
    """Run the machines of a deployment, without boards, processes or a rosbridge server.

    Args:
        folder: The folder that `toolchain build` wrote.
        readings: The readings by the names of their variables, as in messages: numbers in their units, or names of
            states. A variable that is not named, or is None, has no reading, whatever its `on_missing` says of messages.
        bank: Set of seeds; each gives another draw of the same distribution.

    Returns:
        The posterior in the shape of the model, with its labels; `report` is None.

    Raises:
        LabelError: The deployment has no variable of this name.
        PosteriorError: The machine has replicas or readings for each line; use `machines.posterior`.
        ToolchainError: The deployment is damaged, or a reading cannot be used.
        NoPosteriorError: All counts are 0 for these readings.
    """
    import numpy as np

    from machines.kind import FrameInput
    from pcie_shim.programming_file import read_image
    from toolchain.deployment.address import to_address

    deployment = load_deployment(Path(folder))
    names = [variable.name for variable in deployment.variables]
    for name in readings:
        if name not in names:
            raise LabelError(
                f"the deployment of {folder} has no variable {name!r}; {nearest_name(name, names)}"
            )
    if any(deployment.reading_shape(variable) for variable in deployment.variables):
        raise PosteriorError(
            f"the machine of {folder} has replicas or readings for each line: use machines.posterior with its image"
        )

    def address(variable: Variable) -> int | None:
        value = readings.get(variable.name)
        if isinstance(value, np.generic):
            value = value.item()
        # every machine can do without a reading; `on_missing` is about messages that lack one by mistake
        return None if value is None else to_address(variable, value)

    addresses, row = deployment.machine_addresses(map(address, deployment.variables))
    frame = FrameInput(
        addresses=addresses,
        prior_address=row,
        target_count=deployment.machine.target_count,
        max_cycles=deployment.machine.max_cycles,
        bank=bank,
    )
    machines = [read_image(deployment.image_path(board)).machine for board in range(len(deployment.boards))]
    values, details = deployment.machine.kind.posterior(machines, frame, deployment.machine.variables)
    return Posterior(
        probabilities=tuple(values.tolist()),
        labels=tuple(dimension.label for dimension in deployment.searched),
        sizes=tuple(dimension.size for dimension in deployment.searched),
        heard_ns=time.time_ns(),
        details=details,
    )
