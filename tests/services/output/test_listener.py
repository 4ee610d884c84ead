"""The listener between a server of the test's and its output: what it shows and saves, and when it ends.

fake server  ->  /bm/frame, /BMresults  ->  show_frames, or a program of the pages
"""

import asyncio
import json
import re
from contextlib import asynccontextmanager
from types import SimpleNamespace

import pytest

from posteriors.errors import BadResultError, NoResultError
from posteriors.posterior import Posterior
from services.commands.listen import app
from services.errors import SettingsError
from services.output.listener import show_frames
from services.output.posterior_file import open_result_file
from services.settings import Settings
from tests.casestudies.pretend_stack import certain, frame_message, posterior_message
from tests.command_runner import invoke
from tests.fake_rosbridge import FakeRosbridge
from tests.integration.conftest import ROOT
from tests.patience import PATIENCE
from tests.services.conftest import until


async def say(fake, number, *, published=True):
    await fake.publish("/bm/frame", frame_message({"sec": number, "nanosec": 0}, number, published=published))
    if published:
        await fake.publish("/BMresults", posterior_message(certain(number), 32, 32))


@asynccontextmanager
async def listening(deployment=None, *, count=None, silence=None, file=None, first=PATIENCE):
    """A listener: its server, its task, what it has shown, and a wait until it has shown so many frames."""
    shown = []
    async with FakeRosbridge() as fake:
        task = asyncio.create_task(
            show_frames(
                Settings(first_data_timeout=first),
                deployment,
                uri=fake.uri,
                topic="/BMresults",
                count=count,
                silence=silence,
                show=lambda *frame: shown.append(frame),
                file=file,
            )
        )

        async def have(number):
            await until(lambda: task.done() or len(shown) >= number)
            assert len(shown) == number

        await fake.wait_for_op("subscribe", topic="/BMresults")
        yield SimpleNamespace(fake=fake, task=task, shown=shown, have=have)
        task.cancel()
        await asyncio.wait([task])


async def test_frames_are_shown_and_saved_until_there_are_enough_posteriors(tmp_path):
    file = open_result_file(tmp_path / "out.jsonl")
    async with listening(count=2, file=file) as listener:
        for number in (1, 2, 3):
            await say(listener.fake, number, published=number != 2)
        assert await asyncio.wait_for(listener.task, PATIENCE) == 0
    file.close()
    assert [(each.number, isinstance(each, Posterior)) for each, _ in listener.shown] == [
        (1, True),
        (2, False),
        (3, True),
    ]
    saved = map(json.loads, (tmp_path / "out.jsonl").read_text().splitlines())
    assert [each["frame"] for each in saved] == [1, 2, 3]


async def test_a_lost_server_is_waited_for_aloud(capsys):
    async with listening() as listener:
        await say(listener.fake, 1)
        await listener.have(1)
        capsys.readouterr()
        await listener.fake.vanish()
        await listener.fake.come_back()
        await listener.fake.wait_for_op("subscribe", topic="/BMresults", count=2)
        await say(listener.fake, 2)
        await listener.have(2)
        gone, back = capsys.readouterr().err.splitlines()
        assert gone.startswith("warning: ")
        assert listener.fake.uri in gone
        assert listener.fake.uri in back


@pytest.mark.parametrize("silence", [None, 0.1])
async def test_silence_ends_a_run_that_has_not_begun_or_that_names_its_limit(silence, capsys):
    async with listening(first=0.1) as listener:
        with pytest.raises(NoResultError):
            await asyncio.wait_for(listener.task, PATIENCE)
    async with listening(first=PATIENCE if silence else 0.5, silence=silence) as listener:
        await asyncio.sleep(silence or 0.0)  # what ends a run that has begun is not for the first frame
        await say(listener.fake, 1)
        await listener.have(1)
        if silence:
            with pytest.raises(NoResultError):
                await asyncio.wait_for(listener.task, PATIENCE)
            return
        for number in (2, 3):
            said = ""
            await until(lambda said=said: "within 0.5 s" in said + capsys.readouterr().err)
            await say(listener.fake, number)
            await listener.have(number)


async def test_nonsense_ends_a_run_that_has_not_begun_and_is_reported_later(capsys):
    async with listening() as listener:
        await listener.fake.publish("/BMresults", {"data": "nonsense"})
        with pytest.raises(BadResultError):
            await asyncio.wait_for(listener.task, PATIENCE)
    async with listening() as listener:
        await say(listener.fake, 1)
        await listener.have(1)
        await listener.fake.publish("/BMresults", {"data": "nonsense"})
        await say(listener.fake, 2)
        await listener.have(2)
        assert "warning: a message on /BMresults is not " in capsys.readouterr().err


async def test_a_posterior_of_another_deployment_ends_the_run(boat):
    other = frame_message({"sec": 1, "nanosec": 0}, 1, published=False)
    other["status"][0]["hardware_id"] = "another stack"
    async with listening(boat) as listener:
        await listener.fake.publish("/bm/frame", other)
        await say(listener.fake, 2)
        with pytest.raises(SettingsError):
            await asyncio.wait_for(listener.task, PATIENCE)
        assert listener.shown == []


async def test_a_posterior_is_larger_than_most_messages():
    async with listening(count=1) as listener:
        await listener.fake.publish("/BMresults", {"data": [1 / 60_001] * 60_000})
        assert await asyncio.wait_for(listener.task, PATIENCE) == 0
        assert listener.shown[0][0].sizes == (60_000,)


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("--uri", "ws://127.0.0.1:1", "--connect-timeout", "0.1"), 3),
        ((), 2),
        (("--uri", "ws://127.0.0.1:1", "--plot", "--json"), 2),
        (("--uri", "ws://127.0.0.1:1", "--save", "out.txt"), 2),
    ],
)
def test_what_cannot_be_is_one_sentence(options, code):
    ended = invoke(app, options)
    assert (ended.exit_code, ended.stderr.count("\n")) == (code, 1)
    assert ended.stderr.startswith("error: ")


async def test_the_programs_of_the_page(capsys):
    page = (ROOT / "docs/how-to/listening.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    blocks = [each for each in blocks if "ws://" in each and "from posteriors import" in each]
    assert len(blocks) == 2
    for block in blocks:
        async with FakeRosbridge() as fake:
            program = re.sub(r"ws://[^\"]*", fake.uri, block)
            running = asyncio.create_task(asyncio.to_thread(exec, program, {"__name__": "__main__"}))
            await fake.wait_for_op("subscribe", topic="/BMresults")
            for number in (1, 2, 3):
                await say(fake, number)
            await asyncio.wait_for(running, PATIENCE)
        first, *_, mean, last = capsys.readouterr().out.splitlines()
        assert first.startswith("1 {'y': 0")
        assert re.match(r"(3 )?{'y': 0.0, 'x': 3.0} ", mean)
        assert re.match(r"3 posteriors$|.* too slow: 0$", last)
