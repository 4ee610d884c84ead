"""Client in a container next to the stack: it compares each result with float64 fusion of the same readings.

It prints one JSON object per result: `at` (Unix time), `number`, `cycles`, `tv` (total variation to float64,
0..1), or `wrong` with a sentence. With --bits N it recomputes N results with the reference kernel, compares
cycles, counts and posterior exactly, and ends.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from bridge.client import Ros, connect
from bridge.errors import BridgeError
from bridge.stamps import stamp_ns
from casestudies.boat.geometry import SENSOR_NAMES
from casestudies.boat.messages import SENSORS_TOPIC, SENSORS_TYPE
from casestudies.boat.model import model
from casestudies.listening import listen
from casestudies.truths import Instance
from machines.bm1 import Start
from machines.posterior import joint_posterior
from machines.reference import ReferenceBM1
from pcie_shim.programming_file import read_image
from toolchain.deployment import load_deployment
from toolchain.models.model import exact_posterior

KEPT = 512
"""Number of readings kept until their results arrive."""
BITS_CYCLES = 1 << 13
"""Cycle limit of recomputed frames, because the reference kernel takes seconds for longer ones."""
FACTOR = float(os.environ.get("TEST_PATIENCE") or 1)
PATIENCE_S = 180.0 * FACTOR
"""Seconds to wait for the server, and for the first result."""


class Readings:
    """Readings from /boat/sensors, by stamp."""

    def __init__(self) -> None:
        self._heard: OrderedDict[int, tuple[int, ...]] = OrderedDict()
        self._news = asyncio.Event()

    async def receive(self, ros: Ros) -> None:
        """Store received readings until cancelled."""
        async for message in ros.subscribe(SENSORS_TOPIC, SENSORS_TYPE, queue_size=KEPT):
            fields: dict[str, Any] = dict(message.msg)
            stamp = stamp_ns(fields["header"]["stamp"])
            assert stamp is not None
            self._heard[stamp] = tuple(int(fields[name]) for name in SENSOR_NAMES)
            if len(self._heard) > KEPT:
                self._heard.popitem(last=False)
            self._news.set()

    async def of(self, stamp: int) -> tuple[int, ...] | None:
        """Return the readings with this stamp; None if they were not received."""
        deadline = time.monotonic() + FACTOR
        while stamp not in self._heard and time.monotonic() < deadline:
            self._news.clear()
            try:
                await asyncio.wait_for(self._news.wait(), deadline - time.monotonic())
            except TimeoutError:
                break
        return self._heard.get(stamp)


class Bits:
    """The deployment's boards, computed by the reference kernel in this process."""

    def __init__(self, folder: Path) -> None:
        self._deployment = load_deployment(folder)
        self._machines = [
            read_image(self._deployment.image_path(board)).machine
            for board in range(len(self._deployment.boards))
        ]

    def differences(self, instance: Instance, addresses: tuple[int, ...]) -> str:
        """Return the differences; empty if there are none."""
        report, posterior = instance.report, instance.posterior
        assert report is not None
        assert report.number is not None
        assert posterior is not None
        machine = self._deployment.machine
        counts, cycles = [], []
        for at, (board, outcome) in enumerate(zip(self._machines, report.boards, strict=True)):
            kernel = ReferenceBM1(board)
            if outcome.cycles:
                # it stopped there, by itself or because another board overflowed
                bank = report.number % machine.rng_banks
                kernel.start(
                    Start(
                        addresses=addresses,
                        target_count=machine.target_count,
                        max_cycles=outcome.cycles,
                        bank=bank,
                    )
                )
            if (kernel.cycles, int(kernel.counts.sum())) != (outcome.cycles, outcome.counts_total):
                return f"board {at} says {outcome.cycles} cycles, counts {outcome.counts_total}; the reference {kernel.cycles}, {int(kernel.counts.sum())}"
            counts.append(kernel.counts)
            cycles.append(kernel.cycles)
        ours = joint_posterior(counts, cycles)
        if ours is None or not np.array_equal(ours, np.asarray(posterior.probabilities)):
            return "the posterior is not that of these counts"
        return ""


async def check(uri: str, cells: tuple[int, int], bits: int) -> None:
    """Print a line for each result, until `bits` of them are recomputed unless that is 0."""
    width, height = cells
    boat = model(width, height)
    reference = Bits(Path(os.environ["BM_DEPLOYMENT"])) if bits else None
    readings = Readings()
    async with connect(uri) as ros, listen(ros) as listener:
        receiving = asyncio.create_task(readings.receive(ros))
        print(json.dumps({"listening": uri}), flush=True)
        number = 0
        while not bits or number < bits:
            instance = await listener.next(PATIENCE_S)
            report, posterior = instance.report, instance.posterior
            if posterior is None or report is None:
                continue
            if reference is not None and max(board.cycles or 0 for board in report.boards) > BITS_CYCLES:
                continue
            number += 1
            addresses = await readings.of(report.stamp_ns)
            line: dict[str, Any] = {
                "at": posterior.heard_ns / 1e9,
                "number": report.number,
                "cycles": report.cycles,
            }
            if addresses is None:
                line["wrong"] = "no reading has its stamp"
            elif len(posterior.probabilities) != width * height:
                line["wrong"] = f"it has {len(posterior.probabilities)} lines, not {width * height}"
            else:
                exact = exact_posterior(boat, addresses)
                line["tv"] = round(float(0.5 * np.abs(np.asarray(posterior.probabilities) - exact).sum()), 4)
                if reference is not None and (wrong := reference.differences(instance, addresses)):
                    line["wrong"] = wrong
            print(json.dumps(line), flush=True)
        receiving.cancel()


async def main() -> None:
    """Parse the flags, wait for the server, and check results."""
    parser = argparse.ArgumentParser()
    parser.add_argument("uri")
    parser.add_argument("--cells", type=int, nargs=2, default=(32, 32), help="width and height of the map")
    parser.add_argument("--bits", type=int, default=0)
    arguments = parser.parse_args()
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            await check(arguments.uri, tuple(arguments.cells), arguments.bits)
        except BridgeError:
            if time.monotonic() > deadline:
                raise
            await asyncio.sleep(0.2)
        else:
            return


asyncio.run(main())
