"""The model that a command line names: a folder with its settings, or a network's file with the question to it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Self

from machines.parameters import ADDRESS_BITS_MAX
from toolchain.errors import BuildError
from toolchain.flag_values import key_values, names_in
from toolchain.models.case_study import load_model, model_path
from toolchain.networks import is_network, read_network

if TYPE_CHECKING:
    from pathlib import Path

    from toolchain.models.model import Model
    from toolchain.options import OnMissing


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkQuestion:
    """A question to a network as a user writes it.

    Attributes:
        searched: Names with commas between them.
        known: Names with commas between them.
        given: `NAME=STATE` each.
        prior_select: A name, or nothing.
        on_missing: What an absent reading is.
    """

    searched: str = ""
    known: str = ""
    given: tuple[str, ...] = ()
    prior_select: str = ""
    on_missing: Literal["error", "missing"] = "error"

    @classmethod
    def of_flags(
        cls, searched: str, known: str, given: list[str] | None, prior_select: str, on_missing: OnMissing
    ) -> Self:
        """Return what the five flags of a command say."""
        return cls(
            searched=searched,
            known=known,
            given=tuple(given or ()),
            prior_select=prior_select,
            on_missing=on_missing.value,
        )

    @property
    def flags(self) -> list[str]:
        """The flags that were given."""
        said = {
            "--searched": self.searched,
            "--known": self.known,
            "--given": self.given,
            "--prior-select": self.prior_select,
            "--on-missing": self.on_missing != "error",
        }
        return [flag for flag, value in said.items() if value]


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """What of a model and its machine is still as the user wrote it.

    Attributes:
        settings: `KEY=VALUE` each, for the model's parameters.
        bits: `NAME=BITS` each.
        interface: `20x1200`.
        rng_table: A MIF of random numbers.
        sources: A file that says which variable comes from which topic.
        device: What a board has; then as many boards are taken as the lines need.
    """

    settings: tuple[str, ...] = ()
    bits: tuple[str, ...] = ()
    interface: str | None = None
    rng_table: Path | None = None
    sources: Path | None = None
    device: str | None = None


def model_file(path: Path) -> Path:
    """Return the file that a model is read from: a network's own, or a folder's `model.py`."""
    return path if is_network(path) else model_path(path)


def read_model(path: Path, question: NetworkQuestion, unread: Unread) -> Model:
    """Return a user's model, its columns as wide as asked for.

    Raises:
        ModelError: The model has a mistake, or a column can't be so wide.
        BuildError: Flags that don't fit the model.
    """
    values = key_values(unread.settings)
    model = (
        _network_model(path, question, values) if is_network(path) else _case_model(path, question, values)
    )
    return _with_bits(model, key_values(unread.bits, "--bits", "range=8"))


def _with_bits(model: Model, bits: dict[str, str]) -> Model:
    names = [variable.name for variable in model.variables]
    widths: dict[str, int] = {}
    for name, text in bits.items():
        if name not in names:
            message = (
                f"--bits {name}={text}: the model has no such variable; it has {', '.join(names) or 'none'}"
            )
            raise BuildError(message)
        if not re.fullmatch(r"\d{1,3}", text, re.ASCII) or not 1 <= int(text) <= ADDRESS_BITS_MAX:
            message = f"--bits {name}={text}: expected 1 to {ADDRESS_BITS_MAX} bits"
            raise BuildError(message)
        widths[name] = int(text)
    select = model.prior_select
    return replace(
        model,
        known=tuple(replace(known, bits=widths.get(known.name, known.bits)) for known in model.known),
        prior_select=None if select is None else replace(select, bits=widths.get(select.name, select.bits)),
    )


def _network_model(path: Path, question: NetworkQuestion, settings: dict[str, str]) -> Model:
    """Return the model that answers a question to a network's file.

    Raises:
        ModelError: The file is no network, or the question has no form that a BM1 computes.
        BuildError: No question, or one that can't be read.
    """
    if settings:
        message = f"--set {next(iter(settings))}: a network's file has no parameters; --given NAME=STATE fixes a variable"
        raise BuildError(message)
    if not question.searched:
        message = f"{path} is a network: say what is searched and known, such as --searched A --known B,C"
        raise BuildError(message)
    joint = read_network(path, on_missing=question.on_missing)
    return joint.ask(
        names_in("--searched", question.searched),
        names_in("--known", question.known),
        given=key_values(question.given, "--given", "smoke=yes"),
        prior_select=question.prior_select or None,
    ).model()


def _case_model(path: Path, question: NetworkQuestion, settings: dict[str, str]) -> Model:
    if question.flags:
        message = (
            f"{question.flags[0]} asks a network's file, but {path} is none; model.py asks its own question"
        )
        raise BuildError(message)
    return load_model(path, settings)
