"""The campaign: rounds of faults until enough frames are judged (see scripts/campaign)."""

from __future__ import annotations

import argparse
import asyncio
import math
import random
import shutil
import statistics
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from scripts.campaigning.connections import TOPIC, TYPE
from scripts.campaigning.expected import BUILD_OPTIONS, Expected
from scripts.campaigning.faults import SHORT, Kind, Schedule
from scripts.campaigning.observer import Finding, Flaw
from scripts.campaigning.round import Round, RoundResult
from scripts.campaigning.stack import Topology
from scripts.running.flags import ScriptParser
from scripts.running.processes import ROOT, Process, run_script

FRAMES = 100_000
STEPS, CALM = 10, 200
"""Number of steps in a round, and of results between two of them."""
SHORT_CALM = 150
LIMIT = 24 * 3600.0
FEWEST_SAMPLES = 3
MOST_DESCRIPTORS = 8
"""Number of descriptors by which a process may grow, at rest."""
MOST_KIB = 32 * 1024
"""KiB by which a process may grow in its second half."""


async def build(folder: Path) -> Path:
    """Build the deployment of the campaign's model, and return its folder."""
    path = folder / "campaign"
    toolchain = Process("toolchain", folder / "toolchain.log")
    await toolchain.start(
        *("toolchain", "build", str(ROOT / "scripts" / "campaigning" / "model"), "-o", str(path)),
        *("--uri", "ws://127.0.0.1:9090", "--topic", TOPIC, "--type", TYPE, *BUILD_OPTIONS),
    )
    await toolchain.succeed()
    return path


async def run(options: argparse.Namespace, folder: Path) -> int:
    """Run rounds until enough frames are judged or one has findings, and return the exit code."""
    deployment = await build(folder)
    expected = await asyncio.to_thread(Expected, deployment)
    kinds = [Kind(each) for each in options.only or Kind]
    topologies = [Topology[name] for name in options.topology or Topology.__members__]
    begun = time.monotonic()
    results: list[RoundResult] = []
    faults: Counter[str] = Counter()
    seed = options.seed
    while sum(result.frames for result in results) < options.frames:
        topology, steps, calm = Topology.APART, list(SHORT), SHORT_CALM
        if not options.short:
            topology, calm = topologies[seed % len(topologies)], CALM
            steps = Schedule(random.Random(seed), topology, kinds).steps(STEPS)
        place = folder / f"r{seed}"
        place.mkdir(mode=0o700)
        round_ = Round(place, topology, deployment, expected.outcome, seed, calm_frames=calm)
        result = await round_.run(steps)
        shutil.rmtree(place, ignore_errors=True)
        results.append(result)
        done = steps[: result.steps]
        faults.update(f"{fault.kind}: {fault.what}" for step in done for fault in step)
        print(
            f"{'FAIL' if result.findings else 'ok  '} seed {seed} ({topology}): {len(done)} steps, "
            f"{result.frames} results, {time.monotonic() - begun:.0f} s in all",
            flush=True,
        )
        if result.findings:
            for finding in result.findings[:10]:
                print(f"    {finding.flaw}: {finding.sentence}")
            print("\n".join(f"    | {line}" for line in result.words.splitlines()))
            print("    steps:", *(" + ".join(map(str, step)) for step in done), sep="\n      ")
        if result.findings or options.short:
            break
        seed += 1
    findings = [finding for result in results for finding in result.findings] + growth(results)
    print_sums(results, faults, findings)
    return 1 if findings else 0


def growth(results: list[RoundResult]) -> list[Finding]:
    """Print the median growth of each role, and return processes that grew too much."""
    slopes: dict[str, list[tuple[float, float]]] = {}
    findings = []
    for result in results:
        for (role, pid), samples in result.resources.items():
            steady = samples[len(samples) // 2 :]  # buffers and caches are filled by then
            if len(steady) < FEWEST_SAMPLES:
                continue
            frames, memory, descriptors = zip(*steady, strict=True)
            kib, opened = (statistics.linear_regression(frames, each).slope for each in (memory, descriptors))
            slopes.setdefault(role, []).append((kib, opened))
            if descriptors[-1] - min(descriptors) > MOST_DESCRIPTORS or memory[-1] - memory[0] > MOST_KIB:
                sentence = f"{role} ({pid}): KiB {list(memory)}, descriptors {list(descriptors)}"
                findings.append(Finding(Flaw.GROWTH, sentence))
    for role, of_role in sorted(slopes.items()):
        kib, opened = (1000 * statistics.median(each) for each in zip(*of_role, strict=True))
        print(f"{role}: {kib:+.1f} KiB and {opened:+.2f} descriptors per 1000 frames")
    return findings


def print_sums(results: list[RoundResult], faults: Counter[str], findings: list[Finding]) -> None:
    """Print the sums over all rounds."""

    def listed(counts: Counter[str]) -> str:
        return ", ".join(f"{name} {n}" for name, n in sorted(counts.items()) if n) or "none"

    recoveries = sorted(each for result in results for each in result.recoveries)
    losses = sum((result.losses for result in results), Counter[str]())
    print(
        f"{sum(each.frames for each in results)} results of {sum(each.readings for each in results)} readings "
        f"in {len(results)} rounds, {faults.total()} faults"
    )
    print(f"faults: {listed(faults)}")
    print(f"losses: {listed(losses)}")
    if recoveries:
        seconds = [each for each, _ in recoveries]
        print(
            f"results back after: p50 {statistics.median(seconds):.2f} s, p95 "
            f"{seconds[math.ceil(0.95 * len(seconds)) - 1]:.2f} s, max {seconds[-1]:.2f} s ({recoveries[-1][1]})"
        )
    print(f"wrong: {listed(Counter(str(finding.flaw) for finding in findings))}")


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
        choices=list(Topology.__members__),
        help="run only this topology; repeatable",
    )
    parser.add_argument("--short", action="store_true", help="run one fixed schedule, about a minute")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bmc") as folder:
        return run_script(lambda: run(options, Path(folder)), LIMIT)


if __name__ == "__main__":
    sys.exit(main())
