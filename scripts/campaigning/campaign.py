"""The campaign: rounds of faults until enough frames are judged (see scripts/campaign)."""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import pickle
import random
import shutil
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

from scripts.campaigning.faults import SHORT, Kind, Schedule, Step, step_as_json
from scripts.campaigning.judging.expected import BANKS, BUILD_OPTIONS, Addresses, Expected, Outcome
from scripts.campaigning.judging.growth import growth
from scripts.campaigning.judging.measures import Recovery, RoundResult
from scripts.campaigning.judging.observer import Finding
from scripts.campaigning.round import POOL, Round
from scripts.campaigning.shrinking import shrink
from scripts.campaigning.stack import Topology
from scripts.campaigning.wire import TOPIC, TYPE
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import ROOT, Process, run_script

FRAMES = 100_000
SHORT_CALM = 150
"""Number of results between two steps of `--short`."""
STEPS = 10
"""Number of steps in a round."""
SHRINKING = 300.0
"""Seconds for the search for the shortest failing schedule."""
OUT = ROOT / "out" / "campaign"
LIMIT = 24 * 3600.0


async def deployments(folder: Path, slopes: tuple[str, ...]) -> list[Path]:
    """Build deployments of the same shape with different tables, one for each slope."""
    built = []
    for slope in slopes:
        path = folder / f"campaign{slope}"
        toolchain = Process("toolchain", folder / f"toolchain{slope}.log")
        await toolchain.start(
            *("toolchain", "build", str(ROOT / "scripts" / "campaigning" / "model"), "-o", str(path)),
            *("--uri", "ws://127.0.0.1:9090", "--topic", TOPIC, "--type", TYPE),
            *("--set", f"slope={slope}", *BUILD_OPTIONS),
        )
        await toolchain.succeed()
        built.append(path)
    return built


def expected_of(folders: list[Path]) -> Callable[[str, Addresses, int], Outcome]:
    """Return the correct outcomes of all readings, which are stored in out/campaign for other runs."""
    known: dict[tuple[str, Addresses, int], Outcome] = {}
    of_deployment = {folder.name: Expected(folder) for folder in folders}
    for folder, expected in zip(folders, of_deployment.values(), strict=True):
        kept = OUT / f"{folder.name}-{expected.hash}.pickle"
        outcomes = pickle.loads(kept.read_bytes()) if kept.exists() else {}  # noqa: S301 - our own file
        if missing := {(pair, bank) for pair in POOL for bank in range(BANKS)} - outcomes.keys():
            print(f"computing the right results of {folder.name} (once) ...", file=sys.stderr)
            outcomes |= {(pair, bank): expected.outcome(pair, bank) for pair, bank in missing}
            OUT.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(pickle.dumps(outcomes))
        known |= {(folder.name, pair, bank): right for (pair, bank), right in outcomes.items()}

    def outcome(name: str, addresses: Addresses, bank: int) -> Outcome:
        key = name, addresses, bank
        if key not in known:
            known[key] = of_deployment[name].outcome(addresses, bank)
        return known[key]

    return outcome


@dataclass(slots=True)
class Report:
    """Sums over all rounds."""

    frames: int = 0
    readings: int = 0
    rounds: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    losses: Counter[str] = field(default_factory=Counter)
    transit: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    recoveries: list[Recovery] = field(default_factory=list)
    slopes: dict[str, tuple[float, float]] = field(default_factory=dict)
    failures: list[dict[str, object]] = field(default_factory=list)

    def add(self, result: RoundResult, steps: list[Step]) -> None:
        """Add a round."""
        self.rounds += 1
        self.frames += result.frames
        self.readings += result.readings
        done = steps if result.failed_step < 0 else steps[: result.failed_step + 1]
        self.faults.update(f"{fault.kind}: {fault.what}" for step in done for fault in step)
        self.losses.update(result.losses)
        self.transit.update(dict(zip(("readings", "results"), result.transit, strict=True)))
        self.findings += result.findings
        self.recoveries += result.recoveries

    def lines(self) -> list[str]:
        """Return the lines that the campaign prints at its end."""
        flaws = Counter(str(finding.flaw) for finding in self.findings)
        number = sum(self.faults.values())
        lines = [
            f"{self.frames} results of {self.readings} readings in {self.rounds} rounds, {number} faults",
            "faults: " + ", ".join(f"{name} {number}" for name, number in sorted(self.faults.items())),
            "counted losses: "
            + (", ".join(f"{why} {n}" for why, n in sorted(self.losses.items())) or "none"),
            f"cut off between two processes: {self.transit['readings']} readings, {self.transit['results']} results",
            "wrong: " + (", ".join(f"{flaw} {number}" for flaw, number in flaws.items()) or "nothing"),
        ]
        if self.recoveries:
            seconds = sorted(each.seconds for each in self.recoveries)
            worst = max(self.recoveries, key=lambda each: each.seconds)
            lines.append(
                f"results back after: p50 {statistics.median(seconds):.2f} s, p95 "
                f"{seconds[math.ceil(0.95 * len(seconds)) - 1]:.2f} s, max {worst.seconds:.2f} s ({worst.step})"
            )
        for role, (kib, descriptors) in sorted(self.slopes.items()):
            lines.append(f"{role}: {kib:+.1f} KiB and {descriptors:+.2f} descriptors per 1000 frames")
        return lines


class Campaign:
    """Runs rounds with one seed after the other."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        """Take the command's options, and a folder with a short path."""
        self._options = options
        self._folder = folder
        self._report = Report()
        self._samples: list[RoundResult] = []
        self._rounds = 0

    async def run(self) -> int:
        """Run rounds until enough frames are judged or the time is over, and return the exit code."""
        options = self._options
        folders = await deployments(self._folder, ("1",))
        expected = await asyncio.to_thread(expected_of, folders)
        kinds = [Kind(each) for each in options.only] if options.only else list(Kind)
        begun = time.monotonic()
        calm = SHORT_CALM if options.short else options.calm
        everywhere = [each for each in Topology if each is not Topology.CONTAINERS]
        topologies = [Topology[name] for name in options.topology] if options.topology else everywhere

        async def play(topology: Topology, seed: int, steps: list[Step]) -> RoundResult:
            self._rounds += 1
            place = self._folder / f"r{self._rounds}"
            place.mkdir(mode=0o700)
            try:
                return await Round(place, topology, folders, expected, seed, calm_frames=calm).run(steps)
            finally:
                shutil.rmtree(place, ignore_errors=True)

        seed = options.seed
        while self._report.frames < options.frames:
            topology, steps = Topology.APART, list(SHORT)
            if not options.short:
                topology = topologies[seed % len(topologies)]
                steps = Schedule(random.Random(seed), topology, kinds).steps(options.steps)
            result = await play(topology, seed, steps)
            self._report.add(result, steps)
            self._samples.append(result)
            print(
                f"{'FAIL' if result.findings else 'ok  '} seed {seed} ({topology}): {len(steps)} steps, "
                f"{result.frames} results, {time.monotonic() - begun:.0f} s in all",
                flush=True,
            )
            if result.findings:
                await self._tell_failure(play, topology, seed, steps, result)
                if not options.keep_going:
                    break
            if options.short:
                break
            seed += 1
        self._finish()
        return 1 if self._report.findings else 0

    async def _tell_failure(
        self,
        play: Callable[[Topology, int, list[Step]], Awaitable[RoundResult]],
        topology: Topology,
        seed: int,
        steps: list[Step],
        result: RoundResult,
    ) -> None:
        for finding in result.findings[:10]:
            print(f"    {finding.flaw}: {finding.sentence}")
        print("\n".join(f"    | {line}" for line in result.words.splitlines()))
        flaws = {finding.flaw for finding in result.findings}

        async def fails(some: list[Step]) -> bool:
            again = await play(topology, seed, some)
            return bool(flaws & {finding.flaw for finding in again.findings})

        done = steps if result.failed_step < 0 else steps[: result.failed_step + 1]
        shortest = await shrink(done, fails, seconds=self._options.shrink)
        print(f"    shortest schedule that failed (seed {seed}, {topology}):")
        for step in shortest:
            print("      " + " + ".join(map(str, step)))
        self._report.failures.append(
            {
                "seed": seed,
                "topology": topology.name,
                "findings": [f"{each.flaw}: {each.sentence}" for each in result.findings],
                "schedule": [step_as_json(step) for step in shortest],
            }
        )

    def _finish(self) -> None:
        report = self._report
        report.slopes, findings = growth(self._samples)
        report.findings += findings
        print("\n".join(report.lines()))
        if self._options.json:
            figures = {
                "frames": report.frames,
                "readings": report.readings,
                "rounds": report.rounds,
                "faults": report.faults,
                "losses": report.losses,
                "in_transit": report.transit,
                "findings": Counter(str(each.flaw) for each in report.findings),
                "recoveries": [[each.step, each.seconds] for each in report.recoveries],
                "slopes": report.slopes,
                "failures": report.failures,
            }
            self._options.json.write_text(json.dumps(figures, indent=1) + "\n")


def main() -> int:
    """Run the command."""
    parser = ScriptParser(
        prog="scripts/campaign",
        description="Run the stack, inject faults, and judge every result (docs/how-to/verify.md).",
    )
    parser.add_argument("--frames", type=int, default=FRAMES, help="number of results to judge")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first round")
    parser.add_argument(
        "--only",
        action="append",
        choices=[str(kind) for kind in Kind],
        help="inject only this kind of fault; repeatable",
    )
    parser.add_argument(
        "--topology",
        action="append",
        choices=[each.name for each in Topology],
        help="run only this topology; repeatable",
    )
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of a round")
    parser.add_argument("--calm", type=int, default=200, help="results between two steps")
    parser.add_argument("--short", action="store_true", help="run one fixed schedule, about a minute")
    parser.add_argument("--keep-going", action="store_true", help="continue after a failed round")
    parser.add_argument(
        "--shrink",
        type=float,
        default=SHRINKING,
        help="seconds in which to shorten a failed schedule",
    )
    parser.add_argument("--json", type=output_file, help="write the figures to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bmc") as folder:
        return run_script(lambda: Campaign(options, Path(folder)).run(), LIMIT)


if __name__ == "__main__":
    sys.exit(main())
