"""A command run inside the tests' process, from its command line to its exit code."""

import contextlib
import io
import signal
import sys
from dataclasses import dataclass

from terminal import signals


@dataclass(frozen=True)
class Ended:
    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self):
        return self.stdout + self.stderr


def invoke(app, arguments):
    """Run a command line and return how it ended, with the process's signals as they were."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    code, hooks = 0, (sys.unraisablehook, sys.excepthook)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            app([str(each) for each in arguments])
    except SystemExit as ended:
        code = ended.code
    finally:
        sys.unraisablehook, sys.excepthook = hooks
        signals._received.clear()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Ended(code, *(each.buffer.getvalue().decode() for each in (out, err)))
