"""A real rosbridge server on real ROS 2, in a network with only loopback (see scripts/real-rosbridge).

The server (rosbridge-server-rs, in Rust) and ROS 2 Jazzy's shared libraries come as wheels, pinned and hashed in
real-rosbridge.lock. The libraries are extracted into a folder; Python environments are not changed.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import re
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

LOCK = Path(__file__).with_name("real-rosbridge.lock")
LAYOUT = "1"
"""Version of the installed folder, incremented when its content changes for the same lock."""
HOME_VARIABLE = "ROSBAYES_ROS2_HOME"
READY = "server listening"
"""Line in the server's log once it accepts connections."""
DEFAULT_PORT = 9090
DOWNLOAD_LIMIT = 600.0
GLIBC = (2, 35)
"""The oldest C library for which the server's wheel was built."""

_LIBRARY = re.compile(r"[^/]+\.data/data/lib/([^/]+\.so[.0-9]*)|[^/]+\.libs/([^/]+)")
_SERVER = "rosbridge_server_rs/rosbridge_server_rs_jazzy"
_CONVERTERS = "__rosidl_generator_py.so"
_TAGS = (
    *("--only-binary", ":all:", "--python-version", "3.11", "--implementation", "cp", "--abi", "cp311"),
    *("--platform", "manylinux_2_35_x86_64", "--platform", "manylinux_2_28_x86_64"),
)
_ROS_VARIABLES = ("AMENT_", "CYCLONEDDS_", "FASTDDS_", "FASTRTPS_", "RCUTILS_", "RMW_", "ROS_")
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 0x1


class RealServerError(Exception):
    """The real server is not available here; the text says why, and what to do."""


def home() -> Path:
    """Return the folder in which the server is installed."""
    if chosen := os.environ.get(HOME_VARIABLE):
        return Path(chosen).expanduser().absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache).absolute() / "rosbayes" / "ros2"


def install() -> Path:
    """Return the server's folder (bin, lib), which is first installed if it is missing.

    Raises:
        RealServerError: The machine is not supported, the download fails, or a folder cannot be written.
    """
    digest = hashlib.sha256(LAYOUT.encode() + LOCK.read_bytes()).hexdigest()[:12]
    prefix = home() / f"jazzy-{digest}"
    if prefix.is_dir():
        return prefix
    _check_machine()
    print(f"installing ROS 2 Jazzy and its rosbridge server into {prefix} (once, 70 MB) ...", file=sys.stderr)
    try:
        prefix.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=prefix.parent, prefix=".new-") as folder:
            wheels, made = Path(folder, "wheels"), Path(folder, "made")
            _download(wheels)
            _unpack(sorted(wheels.glob("*.whl")), made)
            try:
                made.rename(prefix)
            except OSError:
                if not prefix.is_dir():  # otherwise another process was faster, and its folder is the same
                    raise
    except OSError as error:
        raise RealServerError(
            f"{error.filename or prefix} cannot be written: {error.strerror or error}; set {HOME_VARIABLE} to another folder"
        ) from error
    return prefix


def _check_machine() -> None:
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        raise RealServerError(
            f"ROS 2 comes as wheels for Linux on x86-64 only; this is {sys.platform} on {platform.machine()}"
        )
    kind, version = platform.libc_ver()
    if kind != "glibc" or tuple(int(part) for part in version.split(".")[:2]) < GLIBC:
        wanted = ".".join(map(str, GLIBC))
        raise RealServerError(
            f"the rosbridge server's wheel needs glibc {wanted} or later; this is {kind or 'another C library'} {version}"
        )


def _download(folder: Path) -> None:
    command = [sys.executable, "-m", "pip", "download", "-q", "--disable-pip-version-check", "--no-deps"]
    command += [*_TAGS, "--require-hashes", "-r", str(LOCK), "-d", str(folder)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=DOWNLOAD_LIMIT)
    except subprocess.TimeoutExpired as error:
        raise RealServerError(
            f"pip did not download {LOCK.name} within {DOWNLOAD_LIMIT:.0f} s; try again"
        ) from error
    except subprocess.CalledProcessError as error:
        lines = [line for line in error.stderr.splitlines() if line.startswith("ERROR")]
        output = (lines or error.stderr.splitlines() or [f"exit code {error.returncode}"])[-1]
        raise RealServerError(
            f"pip could not download {LOCK.name}: {output.removeprefix('ERROR: ')}"
        ) from error


def _unpack(wheels: list[Path], prefix: Path) -> None:
    (prefix / "bin").mkdir(parents=True)
    (prefix / "lib").mkdir()
    converters = []
    for path in wheels:
        with zipfile.ZipFile(path) as wheel:
            for entry in wheel.infolist():
                library = _LIBRARY.fullmatch(entry.filename)
                if entry.filename == _SERVER:
                    target = prefix / "bin" / "rosbridge_server"
                elif library is None:
                    continue
                elif entry.filename.endswith(_CONVERTERS):
                    converters.append(prefix / "lib" / library[1])
                    continue
                else:
                    target = prefix / "lib" / (library[1] or library[2])
                with wheel.open(entry) as source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)
    (prefix / "bin" / "rosbridge_server").chmod(0o755)
    # The wheel of this name lacks the library, which only forwards to the one available middleware.
    (prefix / "lib" / "librmw_implementation.so").symlink_to("librmw_fastrtps_cpp.so")
    # Message libraries are linked to their converters for Python, which need a shared libpython to load.
    # Python does not run in the server, so only the names must exist.
    for converter in converters:
        converter.symlink_to("librcutils.so")


def _interface_flags(control: socket.socket, name: str) -> int:
    answer = fcntl.ioctl(control, _SIOCGIFFLAGS, struct.pack("16sh14x", name.encode(), 0))
    return int(struct.unpack("16xh14x", answer)[0])


def network_is_alone() -> bool:
    """Return whether loopback is the only interface of this process's network that is up."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        others = [name for _, name in socket.if_nameindex() if name != "lo"]
        return not any(_interface_flags(control, name) & _IFF_UP for name in others)


def network_command() -> list[str]:
    """Return the prefix of a command that runs in a separate network with only loopback.

    Raises:
        RealServerError: This user or container may not create one.
    """
    if (unshare := shutil.which("unshare")) is None:
        raise RealServerError(
            "`unshare` is not installed, and the real server is to run in a network of its own (Debian: apt-get install util-linux)"
        )
    # a user namespace lets users other than root create a network, if the system allows it
    as_user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    command = [unshare, *as_user, "--net", "--"]
    try:
        subprocess.run([*command, "true"], check=True, capture_output=True, text=True, timeout=10)
    except subprocess.CalledProcessError as error:
        reason = "not even root may make one here" if os.geteuid() == 0 else "this user may not make one"
        advice = "give the container the capability SYS_ADMIN" if os.geteuid() == 0 else "run this as root"
        raise RealServerError(
            f"the real server is to run in a network of its own, and {reason} ({error.stderr.strip()}): {advice}"
        ) from error
    except subprocess.TimeoutExpired as error:
        raise RealServerError(
            f"`{' '.join(command)} true` did not end within 10 s, so there is no network for the real server"
        ) from error
    return [*command, sys.executable, str(Path(__file__).resolve()), "inside"]


def inside(command: list[str]) -> None:
    """Bring up loopback in a new network, then replace this process by the command."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        flags = _interface_flags(control, "lo") | _IFF_UP
        fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", flags))
    become(command)


def become(command: list[str], environment: dict[str, str] | None = None) -> None:
    """Replace this process by a command.

    Raises:
        RealServerError: The command does not exist.
    """
    try:
        os.execvpe(command[0], command, environment or dict(os.environ))  # noqa: S606 - the command needs no shell
    except OSError as error:
        raise RealServerError(f"{command[0]} cannot be started: {error.strerror or error}") from error


def serve(port: int) -> None:
    """Replace this process by the server, on 127.0.0.1.

    Raises:
        RealServerError: This network has other interfaces, on whose addresses ROS's transport would listen.
    """
    prefix = install()
    if not network_is_alone():
        raise RealServerError(
            "the real server runs only in a network with nothing but loopback: start it with `scripts/real-rosbridge alone ...`"
        )
    # variables that a user of ROS has set are for another ROS
    theirs = {name: value for name, value in os.environ.items() if not name.startswith(_ROS_VARIABLES)}
    environment = theirs | {
        "LD_LIBRARY_PATH": str(prefix / "lib"),
        "AMENT_PREFIX_PATH": str(prefix),
        "ROS_DISTRO": "jazzy",
        "ROS_VERSION": "2",
        "ROS_LOG_DIR": str(Path(tempfile.gettempdir(), "rosbayes-ros2-log")),
        # shared memory would leave files behind when the server is killed
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }
    # its rosapi needs rosapi_msgs, which no wheel has
    flags = ["--no-rosapi", "--bind", f"127.0.0.1:{port}", "--log-ansi=false"]
    become([str(prefix / "bin" / "rosbridge_server"), *flags], environment)


def main(arguments: list[str]) -> int:
    """Run the subcommand, and report an error in one sentence."""
    try:
        match arguments:
            case ["install"]:
                print(install())
            case ["alone", _, *_]:
                become([*network_command(), *arguments[1:]])
            case ["inside", _, *_]:
                inside(arguments[1:])
            case ["serve", *port] if not port or (len(port) == 1 and port[0].isdigit()):
                serve(int(port[0]) if port else DEFAULT_PORT)
            case _:
                print(
                    "usage: scripts/real-rosbridge install | alone COMMAND ... | serve [PORT]",
                    file=sys.stderr,
                )
                return 2
    except RealServerError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C)", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
