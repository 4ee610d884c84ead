"""The flags for a model and its build options, and the functions that read both from a command line."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from machines.parameters import RngKind
from toolchain.bounded_files import open_regular
from toolchain.building.options import FILL, BuildOptions, MachineOptions, TargetOptions
from toolchain.building.sources import read_sources
from toolchain.deployment import ModelSection, parse_interface
from toolchain.errors import BuildError, NetworkFileError, counted
from toolchain.flags import Bits, Settings, key_values, names_in
from toolchain.networks import is_network, read_network

if TYPE_CHECKING:
    from toolchain.building.machine import MachinePlan
    from toolchain.models.joint import Question
    from toolchain.models.model import Model

ModelPath: TypeAlias = Annotated[
    Path,
    typer.Argument(
        help="Folder with model.py, a network file (.bif, .xmlbif, .uai, .net, .xdsl; .gz), or an installed model: boat.",
        metavar="MODEL",
    ),
]


@dataclass(frozen=True, kw_only=True)
class ModelFlags:
    """Flags that describe a model: parameters of a `model.py`, or variables of a network file."""

    settings: Settings = None
    searched: Annotated[str, typer.Option(help="Searched variables.", metavar="A,B")] = ""
    known: Annotated[
        str, typer.Option(help="Variables with readings, in the order of the columns.", metavar="A,B")
    ] = ""
    given: Annotated[
        list[str] | None,
        typer.Option(help="A variable with a fixed state; repeatable.", metavar="NAME=STATE"),
    ] = None
    prior_select: Annotated[
        str, typer.Option(help="Variable whose readings select the prior.", metavar="NAME")
    ] = ""
    previous: Annotated[
        str,
        typer.Option(
            help="For a filter: the searched variables one frame earlier, in the same order.", metavar="A0,B0"
        ),
    ] = ""
    on_missing: Annotated[Literal["error", "missing"], typer.Option(help="Meaning of an absent reading.")] = (
        "error"
    )

    def over(self, built: ModelSection) -> "ModelFlags":
        """Return these flags. Unset flags get their values from `built`, the section `[model]` of a deployment."""
        found = {
            each.name: getattr(self if getattr(self, each.name) != each.default else built, each.name)
            for each in fields(ModelFlags)
        }
        settings = key_values(built.settings) | key_values(self.settings or ())
        found["settings"] = [f"{key}={value}" for key, value in settings.items()]
        return ModelFlags(**found)

    def section(self, bits: Iterable[str] = ()) -> ModelSection:
        """Return the flags as the section `[model]` of a deployment. `bits` has the values of the flag `--bits`."""
        flags = {each.name: getattr(self, each.name) for each in fields(ModelFlags)}
        lists = {"settings": self.settings or (), "given": self.given or (), "bits": bits}
        return ModelSection(**flags | {key: tuple(values) for key, values in lists.items()})

    @property
    def question(self) -> list[str]:
        """The names of the given flags that are only for network files."""
        values = {
            "--searched": self.searched,
            "--known": self.known,
            "--given": self.given,
            "--prior-select": self.prior_select,
            "--previous": self.previous,
            "--on-missing": self.on_missing != "error",
        }
        return [flag for flag, value in values.items() if value]


@dataclass(frozen=True, kw_only=True)
class BuildFlags(MachineOptions, ModelFlags):
    """Flags for building a machine from a model."""

    bits: Bits = None
    device: Annotated[
        str | None,
        typer.Option(
            help="FPGA of a board: the build uses as many boards as the lines need, and gives the reason.",
            metavar="proce-v-d8",
        ),
    ] = None
    interface: Annotated[
        str | None,
        typer.Option(
            help="Inputs x results of a board's registers.",
            show_default="what the largest board needs",
            metavar="INPUTSxRESULTS",
        ),
    ] = None
    rng_table: Annotated[
        Path | None,
        typer.Option(
            help="With --rng table: the random numbers; without it, they are generated.", metavar="MIF"
        ),
    ] = None


def model_file(path: Path) -> Path:
    """Return the path of the file that defines a model, or raise a ToolchainError if the file is missing.

    `path` is a network file, a `model.py`, the folder of a `model.py`, or the name of an installed model.
    """
    if is_network(path):
        open_regular(path, NetworkFileError).close()
        return path
    from toolchain.models.case_study import existing_model_path

    return existing_model_path(path)


def read_source(path: Path, flags: ModelFlags) -> "Model | Question":
    """Read the model or question in a folder's `model.py`, or the question that the flags ask about a network file."""
    settings = key_values(flags.settings or ())
    return (_network_question if is_network(path) else _case_source)(path, flags, settings)


def read_model(path: Path, flags: ModelFlags, bits: Iterable[str] | None = None) -> "Model":
    """Return the model for a BM1. Each of `bits` is `NAME=BITS`, the address bits of a column."""
    from toolchain.building.machine import with_bits
    from toolchain.models.joint import Question

    source = read_source(path, flags)
    return with_bits(source.model() if isinstance(source, Question) else source, bits or ())


def _network_question(path: Path, flags: ModelFlags, settings: dict[str, str]) -> "Question":
    if settings:
        raise BuildError(
            f"--set {next(iter(settings))}: a network file has no parameters; --given NAME=STATE fixes a variable"
        )
    if not flags.searched:
        raise BuildError(
            f"{path} is a network: give the searched and known variables, such as --searched A --known B,C"
        )
    return read_network(path, on_missing=flags.on_missing).ask(
        names_in("--searched", flags.searched),
        names_in("--known", flags.known),
        given=key_values(flags.given or (), "--given", "smoke=yes"),
        prior_select=flags.prior_select or None,
        previous=names_in("--previous", flags.previous),
    )


def _case_source(path: Path, flags: ModelFlags, settings: dict[str, str]) -> "Model | Question":
    from toolchain.models.case_study import load_question

    if flags.question:
        raise BuildError(
            f"{flags.question[0]} is for a network file, but {path} is not one; model.py contains its own question"
        )
    return load_question(path, settings)


def build_options(
    flags: BuildFlags, target: TargetOptions, sources: Path | None = None, *, is_checked: bool = False
) -> BuildOptions:
    """Return the options of a build. For several topics, the file `sources` replaces `--topic` and `--type`.

    If `is_checked` is true, the model is only checked, not built. `--uri`, `--topic` and `--type` may then be missing.
    """
    from toolchain.outputs.mif import read_table

    place = {"--uri": target.uri, "--topic": target.topic, "--type": target.type}
    missing = [flag for flag, value in place.items() if not value]
    if sources is None and missing and not is_checked:
        raise BuildError(
            f"{missing[0]} is missing: give the source of the readings with --uri, --topic and --type, or with "
            "--sources FILE for several topics"
        )
    if sources is not None:
        for flag, value in (*place.items(), ("--prior-path", target.prior_path)):
            if value and flag != "--uri":
                raise BuildError(
                    f"{flag} {value}: the file of --sources sets that for each topic; omit the flag"
                )
    options = BuildOptions(
        model_flags=flags.section(flags.bits or ()),
        sources=None if sources is None else read_sources(sources, target.uri or None),
        **{each.name: given for each in fields(TargetOptions) if (given := getattr(target, each.name)) != ""},
        **{each.name: getattr(flags, each.name) for each in fields(MachineOptions)},
    )
    if flags.interface is not None:
        try:
            options = replace(options, interface=parse_interface(flags.interface))
        except ValueError as reason:
            raise BuildError(f"--interface: {reason}") from None
    if options.replicas == FILL and flags.device is None:
        raise BuildError("--replicas fill needs the FPGA of the boards: add --device proce-v-d8")
    if flags.rng_table is not None:
        if options.rng is not RngKind.TABLE:
            raise BuildError(f"--rng-table requires --rng table, but this is --rng {options.rng}")
        options = replace(options, rng_table=read_table(flags.rng_table))
    return options


def fit_to_device(plan: "MachinePlan", name: str | None) -> tuple["MachinePlan", str]:
    """Return the plan with as many boards as the machine needs on the device `name`, and the reasons as text.

    With `--replicas fill`, the plan also gets as many replicas as fit a board. If `name` is None, return the plan
    unchanged and an empty text.
    """
    if name is None:
        return plan, ""
    from toolchain.analysis.logic import device_named
    from toolchain.analysis.resources import boards_needed, estimate, most_replicas
    from toolchain.building.machine import partition_lines
    from toolchain.outputs.mif import LENGTH

    options, parameters, device = plan.options, plan.parameters, device_named(name)
    length = LENGTH if options.rng_table is None else options.rng_table.size
    count, why = boards_needed(parameters, device, table_length=length, interface=options.interface)
    if options.partitions > count:
        why += f" --partitions {options.partitions} asks for more."
    options = replace(options, partitions=max(count, options.partitions))
    if options.replicas == FILL:
        board = replace(parameters, lines=partition_lines(parameters.lines, options.partitions)[0].lines)
        most, limit = most_replicas(board, device, table_length=length, interface=options.interface)
        options = replace(options, replicas=max(most, 1))
        parameters = replace(parameters, replicas=options.replicas)
        filled = replace(board, replicas=options.replicas)
        inputs = (options.interface or (0, 0))[0]
        took = estimate(filled, device, table_length=length, inputs=inputs)
        why += (
            f" {counted(options.replicas, 'machine')} fill a board, with {took.alms:,.0f} ALMs ({took.alm_share:.0%}) and "
            f"{took.memories.blocks:,} memory blocks ({took.block_share:.0%}): {limit}."
        )
    return replace(plan, options=options, parameters=parameters), why
