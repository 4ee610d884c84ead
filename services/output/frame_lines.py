"""One frame as lines of text, for `status --frame`."""

import sys
from datetime import datetime
from pathlib import Path

import msgspec

from services.errors import SettingsError
from services.sockets.frame_timeline import FrameTimeline
from services.sockets.http_client import get
from services.sockets.reporting import http_socket
from terminal.errors import ExitCode
from terminal.one_line import one_line

_ANSWER_TIME = 2.0


async def show_frame(directory: Path, number: int, *, json: bool) -> int:
    """Print a frame of the master in a run directory.

    Raises:
        SettingsError: No master answers there, or it does not know the frame.
    """
    path = http_socket(directory, "master")
    try:
        status, body = await get(path, f"/frames/{number}", timeout=_ANSWER_TIME)
        if status != 200:
            raise SettingsError(one_line(body.decode("utf-8", "replace")))
        timeline = msgspec.json.decode(body, type=FrameTimeline)
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        reason = getattr(error, "strerror", None) or error or type(error).__name__
        raise SettingsError(
            f"no master answers at {path} ({reason}); is it running, in this version?"
        ) from None
    if json:
        sys.stdout.buffer.write(body + b"\n")
        sys.stdout.buffer.flush()
    else:
        print("\n".join(one_line(line) for line in lines(timeline)))
    return ExitCode.DONE


def lines(timeline: FrameTimeline) -> list[str]:
    """Return a frame as lines of text."""
    after = "" if timeline.total_ms is None else f" after {timeline.total_ms:.3f} ms"
    why = f": {timeline.why}" if timeline.why else ""
    received, stamp = _time(timeline.received_ns), _time(timeline.stamp_ns)
    found = [
        f"frame {timeline.number}: {timeline.outcome}{after}{why}",
        f"reading received {received}, stamp {stamp}; bank {timeline.bank}",
        "",
        f"{'stage':<17}{'began ms':>10}{'took ms':>10}  process",
    ]
    found += [
        f"{each.stage:<17}{each.began_ms:>10.3f}{each.took_ms:>10.3f}  {each.where}"
        for each in timeline.stages
    ]
    if timeline.local_hops_ms is not None:
        found.append(f"{'local_hops':<17}{'':>10}{timeline.local_hops_ms:>10.3f}  between the processes")
    if timeline.boards:
        found += ["", f"{'board':<8}{'cycles':>10}  stopped by"]
        found += [f"{each.index:<8}{each.cycles:>10}  {each.stopped}" for each in timeline.boards]
    return found


def _time(unix_ns: int) -> str:
    """Return a Unix time as local date and time with microseconds; stamps of a robot may be anything."""
    try:
        return datetime.fromtimestamp(unix_ns / 1e9).astimezone().isoformat(sep=" ", timespec="microseconds")
    except (OverflowError, ValueError, OSError):
        return f"{unix_ns} ns"
