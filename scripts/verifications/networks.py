"""Comparison of network readers and posteriors with an independent library, pyagrum (scripts/verify networks).

pgmpy's wheel (pinned, hashed) --> *.bif --> pyagrum --> tables; each network as XMLBIF, NET and UAI
                                     └─────▶ our readers ──▶ equal tables? ──▶ questions ──▶ pyagrum's posteriors?
"""

import argparse
import gzip
import random
import re
import tempfile
import time
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters, RngKind
from machines.posterior import posterior
from scripts.running.flags import ScriptParser
from scripts.verifications.checks import Tally
from scripts.verifications.installation import use_packages
from toolchain.building.quantise import quantise
from toolchain.errors import ModelError
from toolchain.models.distribution import Distribution
from toolchain.models.joint import JointDistribution
from toolchain.models.model import Model, exact_posterior
from toolchain.networks import read_network

LOCK: Final = Path(__file__).with_name("networks.lock")
EXAMPLES: Final = Path("pgmpy", "utils", "example_models")
"""The networks' folder in pgmpy's wheel."""
NETWORKS: Final = 24
FORMATS: Final = (".bif", ".bifxml", ".net", ".uai")
READ_TOLERANCE: Final = 1e-5
"""Tolerance of a probability, because pyagrum writes only six digits in formats other than BIF."""
INFERENCE_TOLERANCE: Final = 1e-6
MACHINE_TOLERANCE: Final = 0.1
"""Maximum total variation between exact inference and a BM1 that counts to 4095."""
ROWS: Final = 10
TRIES: Final = 300
_IDENTIFIER: Final = re.compile(r"[A-Za-z]\w*")
_JOINED: Final = re.compile(r"(\S+) and (\S+) are not independent given")


class Table(NamedTuple):
    """A variable of pyagrum: its labels, its parents, and its table, whose axes are the child and then the parents."""

    labels: tuple[str, ...]
    parents: list[str]
    values: NDArray[np.float64]


class Asked(NamedTuple):
    """A question that is naive fusion, with rows of readings (the state of each known variable)."""

    searched: tuple[str, ...]
    known: tuple[str, ...]
    model: Model
    rows: tuple[tuple[int, ...], ...]


# The independent library


def plain(label: str) -> str:
    """Return a label that pyagrum accepts: in hexadecimal if it is not an identifier."""
    return label if _IDENTIFIER.fullmatch(label) else "x_" + label.encode().hex()


def load(pyagrum: Any, path: Path) -> Any:
    """Return a BIF file's network as pyagrum reads it."""

    def renamed(match: re.Match[str]) -> str:
        return match[1] + ", ".join(plain(label.strip()) for label in match[2].split(",")) + match[3]

    text = re.sub(r"(type discrete \[ \d+ \] \{ )(.*?)( \};)", renamed, path.read_text())
    other = path.with_suffix(".plain.bif")
    other.write_text(re.sub(r"(?m)^(  \()(.*?)(\) )", renamed, text))
    return pyagrum.loadBN(str(other))


def array_of(table: Any, order: list[str]) -> NDArray[np.float64]:
    """Return a table of pyagrum as an array with the axes in the given order; pyagrum's own order is the reverse."""
    names = list(reversed(table.names))
    found: NDArray[np.float64] = np.transpose(table.toarray(), [names.index(name) for name in order])
    return found


def tables_of(network: Any) -> dict[str, Table]:
    """Return the tables of all variables, in the order of their ids in pyagrum."""
    tables = {}
    for number in range(network.size()):
        variable, table = network.variable(number), network.cpt(number)
        parents = [name for name in reversed(table.names) if name != variable.name()]
        values = array_of(table, [variable.name(), *parents])
        tables[variable.name()] = Table(tuple(variable.labels()), parents, values)
    return tables


def uai(tables: dict[str, Table]) -> str:
    """Return a network as UAI, with the child last in each scope and varying fastest, as the format requires.

    This replaces pyagrum's own writer, in which the first parent varies fastest instead of the child.
    """
    number = {name: str(at) for at, name in enumerate(tables)}
    lines = [
        "BAYES",
        str(len(tables)),
        " ".join(str(len(each.labels)) for each in tables.values()),
        str(len(tables)),
    ]
    for name, table in tables.items():
        scope = [number[each] for each in (*table.parents, name)]
        lines.append(" ".join([str(len(scope)), *scope]))
    for table in tables.values():
        values = np.moveaxis(table.values, 0, -1).ravel().tolist()
        lines += [str(len(values)), " ".join(map(repr, values))]
    return "\n".join(lines) + "\n"


def infer(pyagrum: Any, network: Any, asked: Asked) -> NDArray[np.float64]:
    """Return pyagrum's posteriors, the first searched variable varying slowest, for each row of readings."""
    inference = pyagrum.LazyPropagation(network)
    # Only the part that the targets need is triangulated, because some networks are too large as a whole.
    inference.eraseAllTargets()
    searched, joint = list(asked.searched), len(asked.searched) > 1
    if joint:
        inference.addJointTarget(set(searched))
    else:
        inference.addTarget(searched[0])
    found = []
    for row in asked.rows:
        inference.setEvidence(dict(zip(asked.known, row, strict=True)))
        inference.makeInference()
        table = inference.jointPosterior(set(searched)) if joint else inference.posterior(searched[0])
        found.append(array_of(table, searched).ravel())
    return np.array(found)


# Ours


def difference(joint: JointDistribution, tables: dict[str, Table], suffix: str) -> float:
    """Return the maximum difference between a probability in our tables and in pyagrum's tables.

    If the variables, the shapes or the labels differ, the difference is infinity.
    """
    ours = {each.symbol.name: each for each in joint.factors if isinstance(each, Distribution)}
    number = {name: str(at) if suffix == ".uai" else name for at, name in enumerate(tables)}
    if ours.keys() != set(number.values()):
        return float("inf")
    worst = 0.0
    for name, theirs in tables.items():
        found, parents = ours[number[name]], [number[parent] for parent in theirs.parents]
        labels = found.symbol.type.labels
        labels_differ = suffix != ".uai" and tuple(map(plain, labels)) != theirs.labels
        if {parent.name for parent in found.given} != set(parents) or labels_differ:
            return float("inf")
        axes = [symbol.name for symbol in found.scope]
        table = np.transpose(found.table, [axes.index(axis) for axis in (number[name], *parents)])
        if table.shape != theirs.values.shape:
            return float("inf")
        worst = max(worst, float(np.abs(table - theirs.values / theirs.values.sum(axis=0)).max()))
    return worst


def questions(
    joint: JointDistribution, chance: random.Random
) -> tuple[list[Asked], list[tuple[str, str, list[str]]]]:
    """Return three questions that a BM1 can answer about a network, and pairs of variables that it cannot both know."""
    names = [symbol.name for symbol in joint.symbols]
    asked: list[Asked] = []
    refused: list[tuple[str, str, list[str]]] = []
    for _ in range(TRIES):
        if len(asked) == 3:
            break
        searched = tuple(chance.sample(names, chance.choice((1, 1, 2))))
        if np.prod([joint.symbol(each).size for each in searched]) > 4096:
            continue
        known: tuple[str, ...] = ()
        scopes = [[symbol.name for symbol in factor.scope] for factor in joint.factors]
        near = [name for scope in scopes if set(scope) & set(searched) for name in scope]
        for candidate in dict.fromkeys([*near, *chance.sample(names, min(8, len(names)))]):
            if candidate in searched or len(known) == 4:
                continue
            try:
                joint.ask(searched, [*known, candidate]).model()
                known = (*known, candidate)
            except ModelError as error:
                if (match := _JOINED.match(str(error))) and len(refused) < 5:
                    refused.append((match[1], match[2], list(searched)))
        if len(known) >= 2:
            model = joint.ask(searched, known).model()
            asked.append(Asked(searched, known, model, tuple(draw(model, chance) for _ in range(ROWS))))
    return asked, refused


def draw(model: Model, chance: random.Random) -> tuple[int, ...]:
    """Draw one value of each known variable from the model, so that they are possible together."""
    prior = model.prior_distribution
    line = chance.choices(range(model.lines), weights=prior.tolist())[0]
    return tuple(
        chance.choices(range(known.values), weights=known.table[:, line].tolist())[0] for known in model.known
    )


def machine_difference(asked: Asked) -> float:
    """Return the maximum total variation between exact inference and a BM1 with 16-bit codes and an ideal RNG."""
    model = asked.model
    codes = quantise(model, prob_bits=16)
    parameters = BM1Parameters(
        lines=model.lines,
        sensor_bits=tuple(known.bits for known in model.known),
        prob_bits=16,
        counter_bits=16,
        rng=RngKind.IDEAL,
    )
    machine = BM1Machine(parameters, codes.prior, codes.tables)
    found = [
        posterior(machine, list(row), target_count=4095, max_cycles=2**24) - exact_posterior(model, row)
        for row in asked.rows[:2]
    ]
    return max(float(np.abs(each).sum()) / 2 for each in found)


def check(tally: Tally, pyagrum: Any, path: Path) -> None:
    """Compare with pyagrum one network's tables, read from a file of each format, and its posteriors."""
    began = time.monotonic()
    network = load(pyagrum, path)
    tables = tables_of(network)
    network.saveBIFXML(str(path.with_suffix(".bifxml")))
    network.saveNET(str(path.with_suffix(".net")))
    path.with_suffix(".uai").write_text(uai(tables))
    try:
        joints = {suffix: read_network(path.with_suffix(suffix)) for suffix in FORMATS}
    except ModelError as error:
        tally.report(f"{path.stem} read", began, f"refused: {error}")
        return
    worst = {suffix: difference(joint, tables, suffix) for suffix, joint in joints.items()}
    shown = ", ".join(f"{suffix} {value:.1e}" for suffix, value in worst.items())
    right = max(worst.values()) <= READ_TOLERANCE
    tally.report(
        f"{path.stem} read: {len(tables)} variables", began, None if right else "it differs", f"    {shown}"
    )
    asked, refused = questions(joints[".bif"], random.Random(path.stem))
    for each in asked:
        began = time.monotonic()
        ours = np.array([exact_posterior(each.model, row) for row in each.rows])
        off, machine = float(np.abs(ours - infer(pyagrum, network, each)).max()), machine_difference(each)
        right = off <= INFERENCE_TOLERANCE and machine < MACHINE_TOLERANCE
        what = (
            f"{path.stem}: P({', '.join(each.searched)} | {', '.join(each.known)}), {each.model.lines} lines"
        )
        detail = f"    {off:.1e} from pyagrum; a BM1 {machine:.3f} from exact"
        tally.report(what, began, None if right else "it differs", detail)
    separated = [pair for pair in refused if network.isIndependent(*pair)]
    why = f"separated in the graph: {separated}" if separated else None
    tally.report(f"{path.stem}: {len(refused)} refused pairs", began, why)


def verify(arguments: argparse.Namespace) -> int:
    """Install the library, and check all networks."""
    packages = use_packages("networks", LOCK)
    import pyagrum

    tally, began = Tally(), time.monotonic()
    archives = sorted((packages / EXAMPLES).glob("*.bif.gz"))
    why = None if len(archives) == NETWORKS else f"there are {len(archives)}"
    tally.report(f"{NETWORKS} networks in pgmpy's wheel", began, why)
    with tempfile.TemporaryDirectory(prefix="networks-rosbayes-") as folder:
        for archive in archives:
            path = Path(folder, archive.name.removesuffix(".gz"))
            if not arguments.network or path.stem in arguments.network:
                path.write_bytes(gzip.decompress(archive.read_bytes()))
                check(tally, pyagrum, path)
    return tally.end()


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify networks", __doc__)
    parser.flag("--network", "only this one; repeat for more", action="append", metavar="NAME")
    parser.run_at_once(verify)
