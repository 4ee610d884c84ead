"""Messages to the service manager that started this process (systemd's sd_notify)."""

import contextlib
import os
import socket
from typing import Final

from terminal.one_line import one_line

_SOCKET: Final = "NOTIFY_SOCKET"
_WATCHDOG: Final = ("WATCHDOG_USEC", "WATCHDOG_PID")


class ServiceManager:
    """The service manager, if there is one; a slow or absent one never delays or ends this process."""

    def __init__(self) -> None:
        """Remove the variables of the service manager from the environment, because they do not concern children."""
        # Its datagram socket; empty without a service manager.
        self._address = os.environ.pop(_SOCKET, "")
        if self._address.startswith("@"):  # an abstract socket
            self._address = "\0" + self._address[1:]
        microseconds, pid = (os.environ.pop(name, "") for name in _WATCHDOG)
        is_number = microseconds.isascii() and microseconds.isdigit() and len(microseconds) < 20
        # the watchdog may be meant for another process, such as the one that started this one
        expected = pid in {"", str(os.getpid())} and is_number
        self.watchdog_s: float = int(microseconds) / 1e6 if expected else 0.0
        """Seconds within which it expects a sign of life; 0 if it expects none."""
        # What it has accepted: readiness is sent once, a status when it changes, and both again if its queue was full.
        self._ready = False
        self._status = ""

    def report(self, status: str, *, ready: bool, alive: bool) -> None:
        """Send the state of this process, and a sign of life only if it is `alive`."""
        sent = []
        if ready and not self._ready:
            sent.append("READY=1")
        if status != self._status:
            sent.append(f"STATUS={one_line(status)}")
        if alive and self.watchdog_s:
            sent.append("WATCHDOG=1")
        if self._send(*sent):
            self._ready, self._status = self._ready or ready, status

    def stopping(self) -> None:
        """Report that this process is about to end."""
        self._send("STOPPING=1")

    def _send(self, *assignments: str) -> bool:
        """Send assignments; return whether they were accepted, because the manager's queue may be full."""
        if self._address and assignments:
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.setblocking(False)
                sender.sendto("\n".join(assignments).encode(), self._address)
                return True
        return False
