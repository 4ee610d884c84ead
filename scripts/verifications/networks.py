"""Comparison of network readers and questions with an independent library (scripts/verify networks).

pgmpy's wheel (pinned, hashed) --> *.bif --> pyagrum --> tables, the same networks as XMLBIF, NET and UAI
                                     └─────▶ our readers ──▶ the same tables? ──▶ questions ──▶ pyagrum's posteriors?
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import time
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters, RngKind
from machines.posterior import posterior
from scripts.running.flags import ScriptParser
from toolchain.building.quantise import quantise
from toolchain.errors import ModelError
from toolchain.models.distribution import Distribution
from toolchain.models.joint import JointDistribution
from toolchain.models.model import Model, exact_posterior
from toolchain.networks import read_network

INDEPENDENT = Path(__file__).with_name("independent_networks.py")
LOCK = Path(__file__).with_name("independent-networks.lock")
HOME_VARIABLE = "ROSBAYES_NETWORKS_HOME"
NETWORKS = 24
FORMATS = (".bif", ".bifxml", ".net", ".uai")
LIMIT = 600.0
READ_TOLERANCE = 1e-5
"""Tolerance of a probability, because pyagrum writes six digits into the other formats."""
INFERENCE_TOLERANCE = 1e-6
ROWS = 10
TRIES = 300
_JOINED = re.compile(r"(\S+) and (\S+) are not independent given")


class VerifyError(Exception):
    """The independent library is not available here, or failed; the text says why."""


@dataclass(frozen=True)
class Asked:
    """A question of naive fusion, with rows of readings: the state of each known variable."""

    network: str
    searched: tuple[str, ...]
    known: tuple[str, ...]
    model: Model
    rows: tuple[tuple[int, ...], ...]


class Checks:
    """Counts of passed and failed checks."""

    def __init__(self) -> None:
        self.passed = self.failed = 0

    def check(self, what: str, held: bool, detail: str) -> None:
        """Print the line of a check, and count it."""
        self.passed += held
        self.failed += not held
        print(f"{'ok  ' if held else 'FAIL'}  {what}: {detail}", flush=True)


def environment() -> tuple[Path, Path]:
    """Return the library's Python and pgmpy's wheel, which are first installed if they are missing.

    Raises:
        VerifyError: They cannot be downloaded or installed.
    """
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    home = (
        Path(os.environ.get(HOME_VARIABLE) or Path(cache) / "rosbayes" / "networks").expanduser().absolute()
    )
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    folder = home / f"{version}-{hashlib.sha256(LOCK.read_bytes()).hexdigest()[:12]}"
    python, done = folder / "bin" / "python", folder / ".made"
    if not done.exists():
        print(f"installing pyagrum and pgmpy's networks into {folder} (once, 40 MB) ...", file=sys.stderr)
        venv.create(folder, clear=True, with_pip=True)
        pip = [str(python), "-m", "pip", "--disable-pip-version-check", "-q"]
        options = ["--no-deps", "--require-hashes", "--only-binary", ":all:", "-r", str(LOCK)]
        run([*pip, "download", *options, "-d", str(folder / "wheels")])
        wheels = [path for path in (folder / "wheels").glob("*.whl") if not path.name.startswith("pgmpy-")]
        run([*pip, "install", "--no-deps", "--no-index", *map(str, wheels)])
        done.touch()
    return python, next((folder / "wheels").glob("pgmpy-*.whl"))


def run(command: list[str]) -> None:
    """Run a command of the independent library.

    Raises:
        VerifyError: It fails or takes too long.
    """
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        raise VerifyError(f"{' '.join(command[:4])} ... did not end within {LIMIT:.0f} s") from None
    except subprocess.CalledProcessError as error:
        output = (error.stderr.strip().splitlines() or ["nothing"])[-1]
        raise VerifyError(f"{' '.join(command[:4])} ... failed: {output}") from None


def unpack(wheel: Path, folder: Path) -> list[str]:
    """Extract the networks from pgmpy's wheel, and return their names."""
    names = []
    with zipfile.ZipFile(wheel) as archive:
        for entry in archive.namelist():
            if entry.endswith(".bif.gz"):
                name = Path(entry).name.removesuffix(".bif.gz")
                (folder / f"{name}.bif").write_bytes(gzip.decompress(archive.read(entry)))
                names.append(name)
    return sorted(names)


def compare(checks: Checks, folder: Path, name: str) -> JointDistribution:
    """Read a network in all formats, and compare each with the library's tables."""
    with np.load(folder / f"{name}.npz") as other:
        described: list[dict[str, Any]] = json.loads(str(other["described"]))
        tables = {each["name"]: other[f"table{each['number']}"] for each in described}
    details, held, from_bif = [], True, None
    for suffix in FORMATS:
        began = time.perf_counter()
        try:
            joint = read_network(folder / f"{name}{suffix}")
        except ModelError as error:
            details.append(f"{suffix} refused: {error}")
            held = False
            continue
        took = time.perf_counter() - began
        worst = difference(joint, described, tables, suffix)
        held = held and worst <= READ_TOLERANCE
        details.append(f"{suffix} {worst:.1e} {took:.2f} s")
        if suffix == ".bif":
            from_bif = joint
    entries = sum(table.size for table in tables.values())
    checks.check(f"{name} read", held, f"{len(tables)} variables, {entries} entries; " + ", ".join(details))
    if from_bif is None:
        raise VerifyError(f"{name}.bif cannot be read")
    return from_bif


def difference(
    joint: JointDistribution, described: list[dict[str, Any]], tables: dict[str, Any], suffix: str
) -> float:
    """Return the largest difference between our tables and the library's, infinite if shapes differ."""
    ours = {each.symbol.name: each for each in joint.factors if isinstance(each, Distribution)}
    if len(ours) != len(described):
        return float("inf")
    worst = 0.0
    for each in described:
        name = str(each["number"]) if suffix == ".uai" else each["name"]
        number = {other["name"]: str(other["number"]) for other in described}
        parents = [number[parent] if suffix == ".uai" else parent for parent in each["parents"]]
        if name not in ours or {parent.name for parent in ours[name].given} != set(parents):
            return float("inf")
        found = ours[name]
        if suffix in {".bifxml", ".net"} and found.symbol.type.labels != tuple(each["labels"]):
            return float("inf")
        if suffix == ".bif" and tuple(map(plain, found.symbol.type.labels)) != tuple(each["labels"]):
            return float("inf")
        axes = [symbol.name for symbol in found.scope]
        table = np.transpose(found.table, [axes.index(axis) for axis in (name, *parents)])
        theirs = tables[each["name"]]
        if table.shape != theirs.shape:
            return float("inf")
        worst = max(worst, float(np.abs(table - theirs / theirs.sum(axis=0)).max()))
    return worst


def plain(label: str) -> str:
    """Return a label as the library had to write it."""
    return label if re.fullmatch(r"[A-Za-z]\w*", label) else "x_" + label.encode().hex()


def questions(
    joint: JointDistribution, name: str, chance: random.Random
) -> tuple[list[Asked], list[dict[str, Any]]]:
    """Return three questions of a network that a BM1 can compute, and pairs of variables that were refused."""
    names = [symbol.name for symbol in joint.symbols]
    asked: list[Asked] = []
    refused: list[dict[str, Any]] = []
    for _ in range(TRIES):
        if len(asked) == 3:
            break
        searched = tuple(chance.sample(names, chance.choice((1, 1, 2))))
        if np.prod([joint.symbol(each).size for each in searched]) > 4096:
            continue
        known: tuple[str, ...] = ()
        model = None
        near = [
            symbol.name
            for factor in joint.factors
            if {symbol.name for symbol in factor.scope} & set(searched)
            for symbol in factor.scope
        ]
        candidates = list(dict.fromkeys([*near, *chance.sample(names, min(8, len(names)))]))
        for candidate in candidates:
            if candidate in searched:
                continue
            try:
                model = joint.ask(searched, [*known, candidate]).model()
                known = (*known, candidate)
            except ModelError as error:
                if (match := _JOINED.match(str(error))) and len(refused) < 5:
                    refused.append(
                        {"network": name, "pair": [match[1], match[2]], "searched": list(searched)}
                    )
            if len(known) == 4:
                break
        if model is None or len(known) < 2:
            continue
        model = joint.ask(searched, known).model()
        rows = tuple(draw(model, chance) for _ in range(ROWS))
        asked.append(Asked(name, searched, known, model, rows))
    return asked, refused


def draw(model: Model, chance: random.Random) -> tuple[int, ...]:
    """Draw readings from the model, so that each row is possible."""
    prior = model.prior_distribution
    line = chance.choices(range(model.lines), weights=prior.tolist())[0]
    return tuple(
        chance.choices(range(known.values), weights=known.table[:, line].tolist())[0] for known in model.known
    )


def machine_difference(asked: Asked) -> float:
    """Return the largest total variation between exact inference and a BM1 with 16-bit codes and ideal RNG."""
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


def verify(only: list[str]) -> Checks:
    """Run the whole verification."""
    python, wheel = environment()
    checks = Checks()
    with tempfile.TemporaryDirectory(prefix="networks-rosbayes-") as temporary:
        folder = Path(temporary)
        names = unpack(wheel, folder)
        checks.check("pgmpy's wheel", len(names) == NETWORKS, f"{len(names)} networks")
        for name in set(names) - set(only or names):
            (folder / f"{name}.bif").unlink()
        names = [name for name in names if not only or name in only]
        run([str(python), "-P", str(INDEPENDENT), "read", str(folder)])
        asked: list[Asked] = []
        refused: list[dict[str, Any]] = []
        for name in names:
            joint = compare(checks, folder, name)
            more, pairs = questions(joint, name, random.Random(name))
            asked += more
            refused += pairs
        listed = [
            {"network": each.network, "searched": each.searched, "known": each.known, "rows": each.rows}
            for each in asked
        ]
        (folder / "questions.json").write_text(json.dumps([*listed, *refused]))
        run([str(python), "-P", str(INDEPENDENT), "infer", str(folder)])
        with np.load(folder / "answers.npz") as answers:
            for number, each in enumerate(asked):
                theirs = answers[f"answer{number}"]
                ours = np.array([exact_posterior(each.model, row) for row in each.rows])
                worst = float(np.abs(ours - theirs).max())
                machine = machine_difference(each)
                what = f"{each.network}: P({', '.join(each.searched)} | {', '.join(each.known)})"
                detail = f"{each.model.lines} lines, {worst:.1e} from pyagrum; a BM1 {machine:.3f} from exact"
                checks.check(what, worst <= INFERENCE_TOLERANCE and machine < 0.1, detail)
            wrong = [
                pair
                for number, pair in enumerate(refused, start=len(asked))
                if bool(answers[f"answer{number}"])
            ]
            checks.check(
                "refused pairs",
                not wrong,
                f"{len(refused)}, none of them separated in the graph {wrong or ''}",
            )
    return checks


def main() -> int:
    """Parse the flags and verify."""
    parser = ScriptParser(prog="scripts/verify networks", description="Our readers beside pyagrum's.")
    parser.add_argument("--network", action="append", metavar="NAME", help="only this one; repeat for more")
    arguments = parser.parse_args()
    try:
        checks = verify(arguments.network or [])
    except VerifyError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C)", file=sys.stderr)
        return 130
    print(f"{checks.passed} passed, {checks.failed} failed")
    return 1 if checks.failed else 0


if __name__ == "__main__":
    sys.exit(main())
