"""Answers about a network: its variables, and posteriors for known states from exact inference and from a machine."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from machines.bm2_kind import BM2, kernels_of, run_batches
from machines.kind import FrameInput
from toolchain.analysis.chain import distance
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.building.bm2_machine import chain_machines, plan_bm2
from toolchain.building.choice import model_for
from toolchain.building.machine import plan_machine, whole_machine
from toolchain.building.options import BuildOptions, MachineChoice
from toolchain.errors import BuildError
from toolchain.models.distribution import Distribution, Symbol
from toolchain.models.joint import JointDistribution, Question
from toolchain.models.network import NetworkModel

MOST_CANDIDATES: Final = 100
"""Maximum number of candidates for known variables. Every pair of candidates is tested for independence."""
_MOST_ROWS: Final = 40
_MOST_NAMES: Final = 8
_BAR: Final = 24
_EIGHTHS: Final = " ▏▎▍▌▋▊▉"


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineAnswer:
    """The posterior of a machine on one board, with the default build options and the first bank of seeds."""

    kind: str
    why: str
    """A clause that says why the machine is of this kind."""
    cycles: int
    stopped: str
    """The reason why the board stopped."""
    posterior: NDArray[np.float64] | None
    """float64[lines], one value for each combination of searched states, or None if all counts are 0."""
    total_variation: float
    """Total variation from the exact posterior, or 1 if the machine has no posterior."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The joint posterior of the searched variables. In the order of its values, the first variable varies slowest."""

    network: str
    searched: tuple[Symbol, ...]
    known: Mapping[str, str]
    """The state of each known variable."""
    exact: NDArray[np.float64]
    machine: MachineAnswer | None

    @property
    def _lines(self) -> list[tuple[str, ...]]:
        return list(product(*([each.shown(at) for at in range(each.size)] for each in self.searched)))

    def _most_probable(self) -> list[int]:
        """Return the most probable line of the exact posterior and, if there is one, of the machine's posterior."""
        ours = self.machine.posterior if self.machine else None
        return [int(each.argmax()) for each in (self.exact, ours) if each is not None]

    def as_json(self) -> str:
        """Return the answer as a line of JSON. Its `posterior` has an object for each combination of states."""
        names = [each.name for each in self.searched]
        ours = self.machine.posterior if self.machine else None
        rows: list[dict[str, Any]] = [
            {"states": dict(zip(names, states, strict=True)), "exact": float(self.exact[line])}
            | ({} if ours is None else {"machine": float(ours[line])})
            for line, states in enumerate(self._lines)
        ]
        keys = ("kind", "why", "cycles", "stopped", "total_variation")
        found = {key: getattr(self.machine, key) for key in keys} if self.machine else None
        content = {"network": self.network, "searched": names, "known": dict(self.known)}
        best = [rows[line]["states"] for line in self._most_probable()]
        found = found and found | {"map": best[1] if best[1:] else None}
        return json.dumps(content | {"map": best[0], "posterior": rows, "machine": found}) + "\n"

    def report(self, *, best: bool = False) -> str:
        """Return the answer as bars and sentences. With `best`, show only the most probable states."""
        names, lines = [each.name for each in self.searched], self._lines
        given = ", ".join(f"{name}={state}" for name, state in self.known.items())
        columns = {"exact": self.exact}
        if self.machine and self.machine.posterior is not None:
            columns[self.machine.kind] = self.machine.posterior
        shown: Sequence[int] = range(len(lines))
        if best:
            shown = list(dict.fromkeys(self._most_probable()))
        elif len(lines) > _MOST_ROWS:
            shown = np.argsort(-self.exact, kind="stable")[:_MOST_ROWS].tolist()
        longest = max(float(column[at]) for column in columns.values() for at in shown)
        table = [(*lines[at], *(_bar(float(each[at]), longest) for each in columns.values())) for at in shown]
        question = f"{'max ' if best else ''}P({', '.join(names)}{' | ' + given if given else ''})"
        rows = [f"{self.network}: {question}", *_aligned([(*names, *columns), *table])]
        if (rest := len(lines) - len(shown)) and not best:
            rows.append(f"and {rest:,} less probable ones, together {1 - self.exact[shown].sum():.4f}")
        if found := self.machine:
            lost = f"no posterior ({found.stopped}), which counts as a total variation of 1"
            near = f"total variation from exact inference {found.total_variation:.4f}"
            ends = lost if found.posterior is None else near
            if best and found.posterior is not None:
                ends += ", other most probable states" if shown[1:] else ", the same most probable states"
            rows += [f"{found.kind}: {found.cycles:,} cycles, {ends}.", f"A {found.kind}, since {found.why}."]
        return "\n".join(rows) + "\n"


def answer(
    joint: JointDistribution,
    searched: Sequence[str],
    known: Mapping[str, str],
    machine: MachineChoice | None = None,
) -> Answer:
    """Return the exact posterior of the searched variables for known states.

    If `machine` is given, the answer also has the posterior of that machine.

    Raises:
        ToolchainError: A variable or state does not exist, or the known states are impossible together. It is also
            raised if inference needs a table above the limit, or if this kind of machine cannot answer the question.
    """
    question = joint.ask(searched, list(known))
    addresses = tuple(symbol.index(known[symbol.name]) for symbol in question.known)
    network = question.network()
    exact = network.exact(addresses)
    return Answer(
        network=joint.name,
        searched=question.searched,
        known=dict(known),
        exact=exact,
        machine=None if machine is None else _machine_answer(question, addresses, exact, machine),
    )


def _machine_answer(
    question: Question, addresses: tuple[int, ...], exact: NDArray[np.float64], choice: MachineChoice
) -> MachineAnswer:
    """Run the machine that a build would make, in this process. `addresses` are the addresses of the known states."""
    options = BuildOptions(machine=choice)
    model, why = model_for(question, options)
    if isinstance(model, NetworkModel):
        chains = plan_bm2(model, options, why)
        kernels = kernels_of(chain_machines(chains))
        frame = FrameInput(
            addresses=addresses, target_count=chains.target_count, max_cycles=chains.max_cycles
        )
        posterior = BM2.infer(run_batches(kernels, frame), model.names).posterior
        cycles, stopped = kernels[0].cycles, kernels[0].reason.name
    else:
        plan = plan_machine(model, options)
        run = EmulatedBoards(
            [whole_machine(plan, plan.quantised())],
            target_count=plan.target_count,
            max_cycles=plan.max_cycles,
            stop=options.stop,
        ).run(addresses, 0, 0)
        posterior, cycles, stopped = run.posterior, run.length, run.reasons[0].name
    return MachineAnswer(
        kind="BM2" if isinstance(model, NetworkModel) else "BM1",
        why=why,
        cycles=cycles,
        stopped=stopped.lower(),
        posterior=posterior,
        total_variation=1.0 if posterior is None else distance(posterior, exact),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """A network's variables and the searched variables.

    `apart` says which variables cannot be known variables of the same BM1.
    """

    joint: JointDistribution
    searched: tuple[str, ...] = ()
    apart: Mapping[str, Sequence[str]]
    """For each candidate for a known variable, the candidates that cannot be known variables of the same BM1.

    Two candidates cannot both be known variables of a BM1 if they are dependent given the searched variables.
    """

    def as_json(self) -> str:
        """Return the contents as one JSON object."""
        parents = _parents(self.joint)
        variables: list[dict[str, Any]] = [
            {
                "name": each.name,
                "states": [each.shown(at) for at in range(each.size)],
                "parents": parents.get(each.name, ()),
            }
            | ({"not_with": self.apart[each.name]} if each.name in self.apart else {})
            for each in self.joint.symbols
        ]
        content = {"network": self.joint.name, "searched": self.searched, "variables": variables}
        return json.dumps(content) + "\n"

    def report(self) -> str:
        """Return the contents as a table and a sentence."""
        parents = _parents(self.joint)
        rows = [("variable", "states", "depends on", "not known together with" if self.searched else "")]
        for each in self.joint.symbols:
            last = "(searched)" if each.name in self.searched else _some(self.apart.get(each.name, ()))
            if not self.searched or each.name in self.searched or each.name in self.apart:
                rows.append((each.name, _states(each), ", ".join(parents.get(each.name, ())), last))
        size = f"{len(self.joint.symbols):,} variables, {len(self.joint.factors):,} tables"
        text = [f"{self.joint.name}: {size}", *_aligned(rows)]
        if self.searched:
            text.append(
                f"Given {', '.join(self.searched)}, a BM1 takes known variables of which none is in another's last column; "
                "a BM2 takes any."
            )
        return "\n".join(text) + "\n"


def contents(joint: JointDistribution, searched: Sequence[str] = (), known: Sequence[str] = ()) -> Contents:
    """Return the variables of a network, and the pairs of candidates that are dependent given `searched`.

    Candidates are variables that could be known. `known` names the candidates. If `known` is empty, all variables that
    are not searched are candidates. Without searched variables, there are no pairs.

    Raises:
        ToolchainError: A variable does not exist or is named twice, or there are too many candidates.
    """
    if not searched:
        if known:
            raise BuildError(f"--known {','.join(known)}: add the searched variables, such as --searched A")
        return Contents(joint=joint, apart={})
    names = {joint.symbol(name).name for name in searched}
    candidates = tuple(known) or tuple(each.name for each in joint.symbols if each.name not in names)
    if len(candidates) > MOST_CANDIDATES:
        raise BuildError(
            f"{joint.name} has {len(candidates)} variables that could be known, of which at most {MOST_CANDIDATES} can be "
            "compared: name some with --known A,B"
        )
    apart: dict[str, list[str]] = {name: [] for name in candidates}
    for one, other in joint.ask(searched, candidates).dependent():
        apart[one].append(other)
        apart[other].append(one)
    return Contents(joint=joint, searched=tuple(searched), apart=apart)


def _parents(joint: JointDistribution) -> dict[str, tuple[str, ...]]:
    return {
        factor.symbol.name: tuple(each.name for each in factor.given)
        for factor in joint.factors
        if isinstance(factor, Distribution)
    }


def _states(symbol: Symbol) -> str:
    if symbol.type.labels:
        return _some(symbol.type.labels)
    return f"{symbol.shown(0)} to {symbol.shown(symbol.size - 1)}"


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "".join(f"  {cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _bar(value: float, longest: float) -> str:
    """Return a probability and its bar, whose length is relative to the longest one."""
    whole, part = divmod(round(8 * _BAR * value / longest), 8)
    bar = "█" * whole + _EIGHTHS[part].strip()
    return f"{value:.4f} {bar:{_BAR}}"
