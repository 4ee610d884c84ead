"""The machine of a whole model, before it is divided among boards."""

from dataclasses import dataclass
from typing import Any, Final

from machines.bm1 import BM1Machine
from machines.errors import ParameterError
from machines.parameters import BM1Parameters, PriorMode, RngKind, SensorMode
from toolchain.building.options import BuildOptions
from toolchain.building.quantise import Quantised
from toolchain.deployment import MachineSection, Scale
from toolchain.errors import BuildError
from toolchain.models.model import Model
from toolchain.outputs.rng_table import random_table

_MOST_CODES: Final = 1 << 30
"""Maximum number of codes of all columns, which take 2 bytes each while they are computed."""

MACHINE_KEYS: Final = tuple(
    key for key in MachineSection.model_fields if key in BM1Parameters.__dataclass_fields__ and key != "lines"
)
"""The parameters with the same names in `[machine]`, whose `lines` are those of all boards."""


def machine_options(source: BuildOptions | MachineSection) -> dict[str, Any]:
    """Return the parameters of a machine with the same names in the build options and in `[machine]`."""
    return {key: getattr(source, key) for key in MACHINE_KEYS if key != "prior_bits"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MachinePlan:
    """The machine for a model, before any table is computed."""

    model: Model
    options: BuildOptions
    """The options; only the number of boards may still change, which the parameters do not contain."""
    parameters: BM1Parameters
    """The parameters of the whole machine, with the lines of all boards."""

    @property
    def target_count(self) -> int:
        """The count that stops a machine."""
        asked = self.options.target_count
        return self.parameters.target_count_max if asked is None else asked


def plan_machine(model: Model, options: BuildOptions) -> MachinePlan:
    """Derive the parameters of the whole model's machine from model and options; a BuildError if they contradict."""
    if options.sensor_mode is not SensorMode.COLUMN and options.scaling is Scale.ADDRESS:
        raise BuildError(
            f"--scale address is impossible with --sensor-mode {options.sensor_mode}: lines use different addresses in a "
            "frame, so the factors of addresses would not cancel; use --scale column or none"
        )
    if options.prior_mode is PriorMode.TABLE and options.written_prior is not None:
        flag = "--prior-path" if options.sources is None else options.sources.toml.path
        raise BuildError(f"{flag} is for a written prior: add --prior-mode written")
    if options.prior_mode is PriorMode.WRITTEN and model.prior_select is not None:
        raise BuildError(
            f"the prior is selected by {model.prior_select.name}, so it cannot be written too: leave "
            "--prior-mode written out, or the selection"
        )
    codes = model.lines * sum(2**known.bits for known in model.known)
    if codes > _MOST_CODES and options.sensor_mode is not SensorMode.THRESHOLD:
        raise BuildError(
            f"the tables have {codes} codes, and a machine can have {_MOST_CODES}: use fewer lines, or fewer --bits"
        )
    per_line_codes = options.sensor_mode is SensorMode.THRESHOLD
    try:
        parameters = BM1Parameters(
            lines=model.lines,
            sensor_bits=tuple(options.prob_bits if per_line_codes else known.bits for known in model.known),
            prior_bits=0 if model.prior_select is None else model.prior_select.bits,
            **machine_options(options),
        )
    except ParameterError as reason:
        raise BuildError(str(reason)) from reason
    return MachinePlan(model=model, options=options, parameters=parameters)


def whole_machine(plan: MachinePlan, quantised: Quantised) -> BM1Machine:
    """Return the machine with all lines of a model, or raise a BuildError."""
    parameters, table = plan.parameters, plan.options.rng_table
    if table is None and parameters.rng is RngKind.TABLE:
        table = random_table(parameters.prob_bits)
    try:
        return BM1Machine(parameters, quantised.prior, quantised.tables, table)
    except ParameterError as reason:
        raise BuildError(str(reason)) from reason
