"""The command `listen`, and the programs of README and guide, as their users run them.

pretend stack (bridge's client)  ->  hub (a process)  ->  listen, or a user's program (a process)
"""

import asyncio
import contextlib
import itertools
import json
import os
import pty
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from bridge.client import connect
from bridge.errors import BridgeError
from bridge.stamps import stamp
from services.commands.listen import app
from tests.casestudies.pretend_stack import frame_message
from tests.command_runner import invoke
from tests.integration.conftest import BIN, ROOT, until, until_subscribed
from tests.patience import FACTOR, PROCESS_PATIENCE


def programs(page):
    """The page's Python that hears posteriors."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)
    return [block for block in blocks if "from posteriors import" in block and "ws://" in block]


GUIDE = programs("docs/how-to/listening.md")


def result(number):
    """On the boat's 8 x 8 cells, three quarters in one of them."""
    data = [0.25 / 63] * 64
    data[number % 64] = 0.75
    dims = [{"label": "y", "size": 8, "stride": 64}, {"label": "x", "size": 8, "stride": 8}]
    return {"layout": {"dim": dims, "data_offset": 0}, "data": data}


async def publish_for_ever(uri, rate=40):
    """Every fifth frame has no posterior; a lost hub is waited for."""
    async with connect(uri) as ros:
        frames = await ros.advertise("/bm/frame", "diagnostic_msgs/DiagnosticArray")
        results = await ros.advertise("/BMresults", "std_msgs/Float64MultiArray")
        for number in itertools.count(1):
            published = number % 5 != 0
            with contextlib.suppress(BridgeError):
                await frames.publish(frame_message(stamp(time.time_ns(), 2), number, published=published))
                if published:
                    await results.publish(result(number))
            await asyncio.sleep(1 / rate)


@pytest.fixture
async def stack(stage):
    """The hub and its address; the stack publishes until the test is over."""
    hub, uri = await stage.hub()
    playing = asyncio.create_task(publish_for_ever(uri))
    yield hub, uri
    playing.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await playing


async def printed(running, lines):
    """Wait for so many lines on its standard output."""

    def enough():
        assert running.process.poll() is None, f"it ended: {running.err}"
        return running.out.count("\n") >= lines

    await until(enough, lambda: f"it printed {running.out!r}")
    return running.out.splitlines()


@pytest.mark.process
async def test_lines_and_a_file(stage, stack, boat, tmp_path):
    _, uri = stack
    path = tmp_path / "out.jsonl"
    listen = stage.start("listen", "-d", str(boat), "--uri", uri, "--count", "6")
    saving = stage.start("listen", "--uri", uri, "--count", "3", "--json", "--save", str(path))
    assert [await each.end() for each in (listen, saving)] == [0, 0]
    # in the deployment's units
    lines = [line for line in listen.out.splitlines() if "impossible on every board" not in line]
    assert len(lines) == 6
    lines = [line for line in lines if not line.startswith("frame -:")]  # it subscribed after its report
    pattern = r"frame \d+: y [-\d.]+, x [-\d.]+ with 0.75; mean y [-\d.]+, x [-\d.]+; \d+ cycles; [\d.]+ ms"
    assert [bool(re.fullmatch(pattern, line)) for line in lines] == [True] * len(lines), lines
    # JSON and a file at once
    assert saving.out == path.read_text()
    posteriors = [each for each in map(json.loads, saving.out.splitlines()) if "probabilities" in each]
    assert len(posteriors) == 3
    for each in posteriors:
        assert each["probability"] == 0.75 == each["probabilities"][each["frame"] % 64]
        assert each["best"] == dict(zip("yx", divmod(each["frame"] % 64, 8), strict=True))


@pytest.mark.thorough
async def test_pictures_without_a_terminal_have_no_colour(stage, stack, boat):
    _, uri = stack
    command = ("listen", "-d", str(boat), "--uri", uri, "--plot", "--count", "2")
    drawing = stage.start(*command, environment={"COLUMNS": "40"})
    assert await drawing.end() == 0
    assert "\x1b" not in drawing.out
    assert drawing.out.count("@@") == 2
    words = [each for each in drawing.out.splitlines() if "; mean " in each]
    assert [each.endswith(" ms") for each in words] == [True, True], words


@pytest.mark.thorough
@pytest.mark.parametrize("asked", [{}, {"NO_COLOR": "1"}])
async def test_on_a_terminal_one_picture_changes(stack, asked):
    _, uri = stack
    ours, its = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"}
    listen = subprocess.Popen(
        [str(BIN / "listen"), "--uri", uri, "--plot", "--count", "4"],
        stdout=its,
        stderr=subprocess.DEVNULL,
        env=environment | {"TERM": "xterm-256color", "LINES": "24", "COLUMNS": "80"} | asked,
    )
    os.close(its)

    def read():
        shown = b""
        with contextlib.suppress(OSError):  # the other end was closed
            while part := os.read(ours, 1 << 16):
                shown += part
        return shown.decode()

    try:
        async with asyncio.timeout(PROCESS_PATIENCE):
            shown = await asyncio.to_thread(read)
        assert listen.wait(PROCESS_PATIENCE) == 0
    finally:
        listen.kill()
        os.close(ours)
    assert "\x1b[2K" in shown  # a line that is drawn again
    assert ("\x1b[48;5;" in shown) == (not asked)
    assert ("@@" in shown) == bool(asked)
    assert shown.endswith("\x1b[?25h")  # the cursor is back


@pytest.mark.thorough
async def test_neither_a_lost_server_nor_a_signal_loses_anything(stage, stack, tmp_path):
    hub, uri = stack
    paths = tmp_path / "out.npz", tmp_path / "out.csv"
    both = [stage.start("listen", "--uri", uri, "--save", str(path)) for path in paths]
    before = [len(await printed(listen, 8)) for listen in both]
    hub.send(signal.SIGKILL)
    await hub.end()
    for listen in both:
        await listen.says(rf"warning: .*{uri}")
    await stage.hub(int(uri.rsplit(":", 1)[1]))
    frames = []
    for listen, lines, number, code in zip(
        both, before, (signal.SIGINT, signal.SIGTERM), (130, 143), strict=True
    ):
        await listen.says(rf"(?s)warning: [^\n]*{uri}.*\n[^\n]*{uri}")
        await printed(listen, lines + 5)
        listen.send(number)
        assert await listen.end() == code
        frames.append([int(frame) for frame in re.findall(r"^frame (\d+): cell y", listen.out, re.MULTILINE)])
    with np.load(paths[0]) as saved:
        assert (saved["probabilities"].max(axis=(1, 2)) == 0.75).all()
        assert saved["frame"].tolist() == frames[0]
    assert [int(row.split(",")[0]) for row in paths[1].read_text().splitlines()[1:]] == frames[1]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("--uri", "ws://127.0.0.1:1", "--connect-timeout", "0.1"), 3),
        ((), 2),
        (("--uri", "ws://127.0.0.1:1", "--plot", "--json"), 2),
        (("--uri", "ws://127.0.0.1:1", "--save", "out.txt"), 2),
    ],
)
def test_what_cannot_be(options, code):
    ended = invoke(app, options)
    assert ended.exit_code == code
    assert ended.stderr.splitlines()[-1].startswith("error: ")
    assert ended.stderr.count("\n") == 1


@pytest.mark.thorough
async def test_silence_nonsense_and_another_model(stage, boat):
    _, uri = await stage.hub()
    silent = stage.start("listen", "--uri", uri, "--first-data-timeout", "0.5")
    assert await silent.end() == 3
    async with connect(uri, check_types=False) as ros:
        results = await ros.advertise("/BMresults", "std_msgs/Float64MultiArray")
        # both hear something at once, so that neither waits in vain for the first result
        await results.publish(result(1))
        waiting = stage.start("listen", "--uri", uri, "--first-data-timeout", str(2 * FACTOR))
        ending = stage.start("listen", "--uri", uri, "--timeout", "0.5")
        while not (waiting.out and ending.out):
            assert waiting.process.poll() is None, waiting.err
            await results.publish(result(1))
            await asyncio.sleep(0.05)
        await results.publish({"data": "nonsense"})
        assert await ending.end() == 3
        await waiting.says("warning: a message on /BMresults is not the std_msgs/Float64MultiArray")
        await waiting.says(r"warning: nothing .* within [\d.]+ s")
        before = len(waiting.out.splitlines())
        await results.publish(result(2))
        assert (await printed(waiting, before + 1))[-1].startswith("frame -: cell y 0, x 2 with 0.75")
        waiting.send(signal.SIGTERM)
        assert await waiting.end() == 143
        other = stage.start("listen", "-d", str(boat), "--uri", uri)
        await other.says(uri)
        dims = [{"label": "x", "size": 2, "stride": 2}]
        while other.process.poll() is None:
            await results.publish({"layout": {"dim": dims}, "data": [0.5, 0.5]})
            await asyncio.sleep(0.05)
        assert await other.end() == 2


@contextlib.asynccontextmanager
async def running(text, uri):
    """A page's program as a process, with this server's address."""
    changed = text.replace("ws://robot:9090", uri).replace("ws://127.0.0.1:9090", uri)
    assert changed.count(uri) == 1
    pipes = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE}
    process = await asyncio.create_subprocess_exec(sys.executable, "-u", "-c", changed, cwd=ROOT, **pipes)
    try:
        async with asyncio.timeout(PROCESS_PATIENCE):
            yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()


@pytest.mark.thorough
async def test_the_readmes_ten_lines(stack):
    _, uri = stack
    (text,) = programs("README.md")
    assert len(text.splitlines()) <= 10
    async with running(text, uri) as process:
        said = [(await process.stdout.readline()).decode() for _ in range(9)]
        process.send_signal(signal.SIGINT)
        _, errors = await process.communicate()
    assert (process.returncode, errors) == (0, b"")
    number, best = said[0].split(" ", 1)
    y, x = divmod(int(number) % 64, 8)
    assert best == f"{{'y': {y}, 'x': {x}}} 0.75\n"
    assert said[1] == "(8, 8) ('y', 'x')\n"
    assert f"}} {800 + int(number)} " in said[2]


@pytest.mark.thorough
async def test_the_guides_programs(stage):
    _, uri = await stage.hub()
    for text in GUIDE:
        async with running(text, uri) as process:
            await until_subscribed(uri, "/BMresults")
            playing = asyncio.create_task(publish_for_ever(uri))
            out, errors = await process.communicate()
            playing.cancel()
            await asyncio.gather(playing, return_exceptions=True)
        assert (process.returncode, errors) == (0, b""), errors.decode()
        assert "posteriors\n" in out.decode() or "too slow: 0\n" in out.decode()
        assert out.decode().startswith("1 ")


def test_every_program_of_the_guide_is_run():
    assert len(GUIDE) == (ROOT / "docs/how-to/listening.md").read_text().count("```python") == 2


@pytest.mark.thorough
async def test_a_posterior_larger_than_most_messages(stage):
    """The hub takes it if told to; listen does by itself."""
    hub = stage.start("hub", "--port", "0", "--message-bytes", "4000000")
    uri = (await hub.says(r"ws://\S+"))[0]
    listening = stage.start("listen", "--uri", uri, "--count", "1", "--json")
    await listening.says(uri)
    async with connect(uri, max_size=4_000_000) as ros:
        results = await ros.advertise("/BMresults", "std_msgs/Float64MultiArray")
        while listening.process.poll() is None:
            await results.publish({"data": [1 / 60_001] * 60_000})
            await asyncio.sleep(0.5)
    assert await listening.end() == 0, listening.err
    assert json.loads(listening.out)["sizes"] == [60_000]
