"""The campaign: rounds of faults, until enough frames are judged (see scripts/campaign)."""

import argparse
import asyncio
import random
import shutil
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
from scripts.running.script import ROOT, run_script
from terminal.processes import Process

STEPS, CALM = 10, 200
"""Number of steps in a round, and of results without faults between two steps."""
SHORT_CALM = 150
LIMIT = 24 * 3600.0
MOST_KIB, MOST_DESCRIPTORS = 32 * 1024, 8
"""Maximum growth of a process in the second half of a round, when its caches are full: of memory, and of open files."""


async def run(options: argparse.Namespace, folder: Path) -> int:
    """Run rounds until enough frames are judged or a round has findings, and return the exit code."""
    deployment, toolchain = folder / "campaign", Process("toolchain", folder / "toolchain.log")
    await toolchain.start(
        *("toolchain", "build", str(ROOT / "scripts" / "campaigning" / "model"), "-o", str(deployment)),
        *("--uri", "ws://127.0.0.1:9090", "--topic", TOPIC, "--type", TYPE, *BUILD_OPTIONS),
    )
    await toolchain.succeed()
    expected = await asyncio.to_thread(Expected, deployment)
    kinds = [Kind(each) for each in options.only or Kind]
    topologies = [Topology[name] for name in options.topology or Topology.__members__]
    begun, seed = time.monotonic(), options.seed
    results: list[RoundResult] = []
    faults: Counter[str] = Counter()
    while sum(result.frames for result in results) < options.frames:
        topology, steps, calm = Topology.APART, list(SHORT), SHORT_CALM
        if not options.short:
            topology, calm = topologies[seed % len(topologies)], CALM
            steps = Schedule(random.Random(seed), topology, kinds).steps(STEPS)
        place = folder / f"r{seed}"
        place.mkdir(mode=0o700)
        rng = random.Random(seed)
        result = await Round(place, topology, deployment, expected.outcome, rng, calm_frames=calm).run(steps)
        result.findings += growth(result)
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
            print(result.words, "    steps:", *(" + ".join(map(str, step)) for step in done), sep="\n      ")
        if result.findings or options.short:
            break
        seed += 1
    seconds, step = max((each for result in results for each in result.recoveries), default=(0.0, "no step"))
    flaws = Counter(str(finding.flaw) for finding in results[-1].findings)
    print(f"faults: {listed(faults)}")
    print(f"losses: {listed(sum((result.losses for result in results), Counter()))}")
    print(f"results back after {seconds:.2f} s at most ({step})")
    print(f"wrong: {listed(flaws)}")
    return 1 if flaws else 0


def listed(counts: Counter[str]) -> str:
    """Return counts as text."""
    return ", ".join(f"{name} {number}" for name, number in sorted(counts.items()) if number) or "none"


def growth(result: RoundResult) -> list[Finding]:
    """Return findings about processes whose memory or number of descriptors grew too much."""
    findings = []
    for (role, pid), samples in result.resources.items():
        memory, descriptors = zip(*samples[len(samples) // 2 :], strict=True)
        if descriptors[-1] - min(descriptors) > MOST_DESCRIPTORS or memory[-1] - memory[0] > MOST_KIB:
            sentence = f"{role} ({pid}): KiB {list(memory)}, descriptors {list(descriptors)}"
            findings.append(Finding(Flaw.GROWTH, sentence))
    return findings


def main() -> int:
    """Run the command."""
    parser = ScriptParser(
        "scripts/campaign", "Run the stack, inject faults, and judge every result (docs/how-to/verify.md)."
    )
    parser.flag("--frames", "number of results to judge", 100_000)
    parser.flag("--seed", "seed of the first round", 1, type=int)
    kinds, topologies = [str(kind) for kind in Kind], list(Topology.__members__)
    parser.flag("--only", "only this kind of fault; repeatable", action="append", choices=kinds)
    parser.flag("--topology", "only this one; repeatable", action="append", choices=topologies)
    parser.switch("--short", "run one fixed schedule, about a minute")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bmc") as folder:
        return run_script(lambda: run(options, Path(folder)), LIMIT)


if __name__ == "__main__":
    sys.exit(main())
