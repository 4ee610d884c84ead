"""Client in a container next to the stack: it recomputes results of the boat with the reference kernel.

client.py URI COUNT     compares cycles, counts and posteriors of COUNT results exactly, and prints a line for each
"""

import asyncio
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bridge.client import Ros, connect
from bridge.errors import BridgeError
from bridge.stamps import stamp_ns
from casestudies.boat.sensors import SENSOR_NAMES, SENSORS_TOPIC, SENSORS_TYPE
from casestudies.topics import Instance, listen
from machines.bm1 import Start
from machines.posterior import joint_posterior
from machines.reference import ReferenceBM1
from pcie_shim.programming_file import read_image
from toolchain.deployment import load_deployment

MOST_CYCLES = 1 << 13
"""Cycle limit of recomputed frames, because the reference kernel takes seconds for longer ones."""
LIMIT = 180.0 * float(os.environ.get("TEST_PATIENCE") or 1)
"""Seconds to wait for the server, and for each result."""


async def receive(ros: Ros, heard: dict[int, tuple[int, ...]]) -> None:
    """Store received readings by stamp until cancelled."""
    async for message in ros.subscribe(SENSORS_TOPIC, SENSORS_TYPE, queue_size=512):
        stamp = stamp_ns(message.msg["header"]["stamp"])
        assert stamp is not None
        heard[stamp] = tuple(int(message.msg[name]) for name in SENSOR_NAMES)


def differences(instance: Instance, addresses: tuple[int, ...]) -> str:
    """Compare a result with the reference kernel. Return a clause with the first difference, or an empty text."""
    deployment = load_deployment(Path(os.environ["BM_DEPLOYMENT"]))
    report, posterior, machine = instance.report, instance.posterior, deployment.machine
    assert report is not None
    assert report.number is not None
    assert posterior is not None
    bank = report.number % machine.rng_banks
    start = Start(addresses=addresses, target_count=machine.target_count, max_cycles=MOST_CYCLES, bank=bank)
    counts, cycles = [], []
    for at, outcome in enumerate(report.boards):
        kernel = ReferenceBM1(read_image(deployment.image_path(at)).machine)
        if outcome.cycles:  # it stopped there, by itself or because another board overflowed
            kernel.start(replace(start, max_cycles=outcome.cycles))
        ours = kernel.cycles, int(kernel.counts.sum())
        if ours != (outcome.cycles, outcome.counts_total):
            return f"board {at} reports {outcome.cycles} cycles and counts of {outcome.counts_total}, expected {ours}"
        counts.append(kernel.counts)
        cycles.append(kernel.cycles)
    if len(counts) != len(deployment.boards):
        return f"{len(counts)} boards are in the report"
    right = joint_posterior(counts, cycles)
    if right is None or not np.array_equal(right, np.asarray(posterior.probabilities)):
        return "the posterior is not that of these counts"
    return ""


async def check(uri: str, count: int) -> None:
    """Recompute `count` results, and print a line for each result. Exit with 1 at a wrong result."""
    heard: dict[int, tuple[int, ...]] = {}
    async with connect(uri) as ros, listen(ros) as listener:
        receiving = asyncio.create_task(receive(ros, heard))
        while count:
            instance = await listener.next(LIMIT)
            report = instance.report
            if report is None or instance.posterior is None:
                continue
            # the reading of the first result may have come before this client
            addresses = heard.get(report.stamp_ns)
            if addresses is None or max(board.cycles or 0 for board in report.boards) > MOST_CYCLES:
                continue
            wrong = differences(instance, addresses)
            print(f"frame {report.number}: {wrong or 'right to the bit'}", flush=True)
            if wrong:
                sys.exit(1)
            count -= 1
        receiving.cancel()


async def main() -> None:
    """Wait for the server, and check results."""
    deadline = time.monotonic() + LIMIT
    while True:
        try:
            return await check(sys.argv[1], int(sys.argv[2]))
        except BridgeError:
            if time.monotonic() > deadline:
                raise
            await asyncio.sleep(0.2)


asyncio.run(main())
