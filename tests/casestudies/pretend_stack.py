"""A pretend master for the case studies' tests: answers each reading on a fake server as the publisher would.

reading on TOPIC  ->  fake server  ->  PretendStack  ->  /bm/frame, then /BMresults  ->  viewer, player
"""

import asyncio
import contextlib
import itertools
import time

from tests.patience import PROCESS_PATIENCE
from tests.posteriors.messages import posterior_message, report_message


def certain(line):
    """All of the probability in one of 32 x 32 cells."""
    posterior = [0.0] * 1024
    posterior[line] = 1.0
    return posterior


def frame_message(stamp, number, *, published):
    now = time.time_ns()
    values = {"number": number, "cycles": 800 + number, "counts_total": 4000}
    stages = {"rosbridge_in": 100, "local_hops": 200, "register_writes": 50, "compute": 600, "reads": 50}
    values |= {f"{stage}_us": time for stage, time in stages.items()}
    values |= {"received_ns": now - 1_000_000, "sent_ns": now, "published": str(published).lower()}
    return report_message(
        stamp, "overflow" if published else "no posterior: impossible on every board", **values
    )


class PretendStack:
    """Answers the n-th reading (from 1) with `answer(n, message)`: a posterior, None, or "silent" for no answer."""

    def __init__(self, fake, topic, answer):
        self.fake = fake
        self.topic = topic
        self.answer = answer

    async def __aenter__(self):
        self._task = asyncio.create_task(self._serve())
        return self

    async def __aexit__(self, *_exception):
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _serve(self):
        for number in itertools.count(1):
            await self.fake.wait_for_op("publish", topic=self.topic, count=number, timeout=PROCESS_PATIENCE)
            message = self.fake.ops("publish", topic=self.topic)[number - 1]["msg"]
            answer = self.answer(number, message)
            if isinstance(answer, str):
                continue
            header = message.get("header")
            now = time.time_ns()
            stamp = header["stamp"] if header else {"sec": now // 10**9, "nanosec": now % 10**9}
            await self.fake.publish("/bm/frame", frame_message(stamp, number, published=answer is not None))
            if answer is not None:
                await self.fake.publish("/BMresults", posterior_message(answer, 32, 32))
