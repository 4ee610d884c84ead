"""The posterior of a deployment for given readings, emulated in this process for notebooks and tests of models."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from posteriors.errors import LabelError, PosteriorError
from posteriors.posterior import Posterior
from toolchain.bounded_files import nearest_name
from toolchain.deployment import Deployment, Variable, load_deployment

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from machines.bm1 import BM1Machine
    from toolchain.models import Model, Question


@dataclass(frozen=True, kw_only=True, repr=False)
class EmulatedPosterior(Posterior):
    """The result of the function `posterior`. Its method `exact` returns the exact posterior for the same readings."""

    deployment: Deployment = field(compare=False)
    machines: tuple[Any, ...] = field(compare=False)
    """The emulated machines of the boards. The method `exact` uses these machines.

    The method does not load the deployment's folder again, because the folder may have changed.
    """
    addresses: tuple[int | None, ...]
    """One address for each variable, in the order of the deployment. None stands for a missing reading."""

    def exact(self, model: "Path | str | Model | Question | None" = None, **settings: object) -> Posterior:
        """Return the exact posterior for the same readings, by inference in float64.

        Args:
            model: The model from which the deployment was built. It is a folder with `model.py`, a network file, or a
                `Model` or `Question`. If `model` is None, the function uses the codes in the memories of a BM1. These
                codes are the quantised probabilities of the model. A BM2 needs a model.
            settings: Arguments of the function `model` in `model.py`: the values that the build got with `--set`.

        Returns:
            The posterior. `details["exact"]` is `model`, or `codes` if the codes in the memories were used.

        Raises:
            PosteriorError: `model` is None, but the machine is a BM2. Or `settings` are given, but `model` is None or
                a network file.
            ToolchainError: The model has an error, or the deployment was not built from the model.
        """
        from toolchain.analysis.emulation import joined

        if model is not None:
            values = self._of_model(model, settings)
        elif settings:
            raise PosteriorError(
                f"{', '.join(settings)}: only a model has parameters, so name it first, as in exact('boat')"
            )
        elif self.deployment.machine.is_divided:
            values = self._of_codes(joined(self.machines))
        else:
            raise PosteriorError(
                "the codes of a BM2 are odds of single bits, which have no exact posterior: name the model, such as "
                "exact('clinic.bif')"
            )
        return Posterior(
            probabilities=tuple(values.tolist()),
            labels=self.labels,
            sizes=self.sizes,
            dimensions=self.dimensions,
            heard_ns=self.heard_ns,
            details={"exact": "codes" if model is None else "model"},
        )

    def _of_codes(self, whole: "BM1Machine") -> "NDArray[np.float64]":
        from machines.encode import decode_code
        from toolchain.models.model import fuse

        addresses, row = self.deployment.machine_addresses(self.addresses)
        codes = [whole.prior[row]]
        codes += [table[at] for table, at in zip(whole.tables, addresses, strict=True) if at is not None]
        prior, *likelihoods = (decode_code(each, whole.parameters.prob_bits) for each in codes)
        return fuse(prior, likelihoods)

    def _of_model(
        self, source: "Path | str | Model | Question", settings: Mapping[str, object]
    ) -> "NDArray[np.float64]":
        from toolchain.analysis.chain_inspection import check_same
        from toolchain.analysis.emulation import joined
        from toolchain.analysis.inspection import losses_of
        from toolchain.building.choice import network_for
        from toolchain.models.case_study import load_question
        from toolchain.models.joint import Question
        from toolchain.models.model import exact_posterior
        from toolchain.networks import is_network, read_network

        deployment, select = self.deployment, self.deployment.prior_select
        if isinstance(source, str | Path):
            path, known = Path(source), [variable.name for variable in deployment.sensors]
            if not is_network(path):
                source = load_question(path, {key: str(value) for key, value in settings.items()})
            elif settings:
                raise PosteriorError(f"{', '.join(settings)}: a network file has no parameters")
            else:
                selecting = None if select is None else select.name
                source = read_network(path).ask(self.labels, known, prior_select=selecting)
        if not deployment.machine.is_divided:
            network = network_for(source)
            check_same(deployment, self.machines[0], network)
            return network.exact(self.addresses)
        fusion = source.model() if isinstance(source, Question) else source
        bits = {variable.name: variable.bits for variable in deployment.variables}
        losses_of(deployment, joined(self.machines), fusion.with_bits(bits))
        addresses, _ = deployment.machine_addresses(self.addresses)
        row = None if select is None else self.addresses[deployment.variables.index(select)]
        return exact_posterior(fusion, addresses, prior_address=row)


def posterior(folder: str | Path, readings: Mapping[str, object], *, bank: int = 0) -> EmulatedPosterior:
    """Run the machines of a deployment, without boards, processes or a rosbridge server.

    If the deployment has a filter, the result is the posterior of the filter's first frame.

    Args:
        folder: The folder that `toolchain build` wrote.
        readings: The reading of each variable, by the variable's name. A reading is a number in the variable's unit,
            or the name of a state. A variable that is absent or None has no reading, even if the variable's
            `on_missing` is `error`.
        bank: Number of the set of seeds. Each set gives another draw of the same distribution.

    Returns:
        The posterior in the shape of the model, with labels and units. The attribute `report` is None.

    Raises:
        LabelError: The deployment has no variable with a name in `readings`.
        PosteriorError: `readings` is not a mapping. The error is also raised if the machine has replicas, or if a
            sensor's reading has one number per line. Use `machines.posterior` for such a machine.
        ToolchainError: The deployment is damaged, or a reading cannot be used.
        NoPosteriorError: All counts are 0 for these readings.
    """
    import numpy as np

    from machines.kind import FrameInput
    from pcie_shim.programming_file import read_image
    from toolchain.deployment.address import to_address

    if not isinstance(readings, Mapping):
        raise PosteriorError(f"the readings are {readings!r}, expected values by name, such as {{'D1': 42}}")
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

    addresses = tuple(map(address, deployment.variables))
    columns, row = deployment.machine_addresses(addresses)
    frame = FrameInput(
        addresses=columns,
        prior_address=row,
        target_count=deployment.machine.target_count,
        max_cycles=deployment.machine.max_cycles,
        bank=bank,
    )
    machines = [read_image(deployment.image_path(board)).machine for board in range(len(deployment.boards))]
    values, details = deployment.machine.kind.posterior(machines, frame, deployment.machine.variables)
    return EmulatedPosterior(
        probabilities=tuple(values.tolist()),
        labels=tuple(dimension.label for dimension in deployment.searched),
        sizes=tuple(dimension.size for dimension in deployment.searched),
        dimensions=deployment.searched,
        heard_ns=time.time_ns(),
        details=details,
        deployment=deployment,
        machines=tuple(machines),
        addresses=addresses,
    )
