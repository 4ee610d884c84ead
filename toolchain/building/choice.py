"""The choice of a machine for a model: a BM1 for a naive fusion, a BM2 for every other question (thesis 2.1)."""

from collections.abc import Sequence

from toolchain.building.machine import MachinePlan, with_bits
from toolchain.building.options import BM1Options, BM2Options, BuildOptions, MachineChoice, given_flags
from toolchain.errors import BuildError
from toolchain.models.joint import Question
from toolchain.models.model import Model
from toolchain.models.network import NetworkModel, network_of


def model_for(
    source: Model | Question, options: BuildOptions, bits: Sequence[str] = (), device: str | None = None
) -> tuple[Model | NetworkModel, str]:
    """Return the model of the machine to build, and a clause that says why the machine is a BM1 or a BM2.

    Only a BM1 takes `bits` (address bits of columns, as `NAME=BITS`) and the FPGA `device`. Raises a ToolchainError
    if the machine cannot be built, or if a flag is for the other kind of machine.
    """
    refusal = source.refusal() if isinstance(source, Question) else None
    choice = options.machine
    why = MachinePlan.why if refusal is None else refusal.why
    if choice is MachineChoice.BM1 or (choice is MachineChoice.AUTO and refusal is None):
        _refuse(given_flags(options, BM2Options), "BM2", "BM1", choice, why)
        if refusal is not None:
            raise BuildError(f"{refusal}, or use --machine bm2")
        model = source.model() if isinstance(source, Question) else source
        return with_bits(model, bits), why
    if source.previous if isinstance(source, Question) else source.transition:
        why = "--machine bm2" if refusal is None else str(refusal)
        raise BuildError(
            f"a filter needs a BM1, whose prior the host writes, but this would be a BM2 ({why})"
        )
    flags = given_flags(options, BM1Options)
    flags += [flag for flag, given in (("--bits", bits), ("--device", device)) if given]
    if options.written_prior is not None:
        flags.append("--prior-path" if options.sources is None else "a prior in the file of --sources")
    _refuse(flags, "BM1", "BM2", choice, why, is_possible=refusal is None)
    return network_for(source), "it was asked for" if refusal is None else why


def network_for(source: Model | Question) -> NetworkModel:
    """Return a model or a question as a network. Raises a ModelError if there is no such network."""
    return source.network() if isinstance(source, Question) else network_of(source)


def _refuse(
    flags: list[str], wanted: str, chosen: str, choice: MachineChoice, why: str, *, is_possible: bool = True
) -> None:
    """Raise a BuildError if the user passed any `flags` that only the kind `wanted` has."""
    if flags:
        this = f"{chosen}, since {why}" if choice is MachineChoice.AUTO else f"{chosen} (--machine {choice})"
        other = f", or use --machine {wanted.lower()}" if is_possible else ""
        raise BuildError(f"{flags[0]} is for a {wanted}, but this is a {this}; leave it out{other}")
