"""Fuzzing of the bridge with atheris (see scripts/fuzz).

atheris is not a dependency of the project: it is installed from atheris.lock into a separate environment, which also
sees the project's packages.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from scripts.fuzzing.targets import SEEDS, TARGETS
from scripts.running.flags import ScriptParser

ROOT = Path(__file__).resolve().parents[2]
LOCK = Path(__file__).with_name("atheris.lock")
FINDINGS = ROOT / "tests" / "bridge" / "findings"
OUT = ROOT / "out" / "fuzz"
SECONDS = 600.0
LONGEST_INPUT = 4096
SLOWEST_INPUT = 10
"""Seconds after which an input is considered endless."""
MEMORY = 2048
"""MiB that a target may occupy."""
INSTALL_LIMIT = 600.0
PLAY = """
import sys
import atheris
with atheris.instrument_imports(include=["bridge"]):
    from scripts.fuzzing.targets import TARGETS
target = TARGETS[sys.argv.pop(1)]
atheris.Setup(sys.argv, target)
atheris.Fuzz()
"""


class FuzzError(Exception):
    """Raised when fuzzing cannot continue."""


def python() -> Path:
    """Return the interpreter of the environment with atheris, creating it if it is missing.

    Raises:
        FuzzError: It cannot be installed.
    """
    digest = hashlib.sha256(LOCK.read_bytes() + sys.version.encode()).hexdigest()[:12]
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    home = Path(cache).absolute() / "rosbayes" / f"fuzz-{digest}"
    if home.is_dir():
        return home / "bin" / "python"
    print(f"installing atheris into {home} (once) ...", file=sys.stderr)
    home.parent.mkdir(parents=True, exist_ok=True)
    pip = ["-m", "pip", "install", "-qq", "--disable-pip-version-check", "--only-binary", ":all:"]
    try:
        subprocess.run([sys.executable, "-m", "venv", home], check=True, timeout=INSTALL_LIMIT)
        subprocess.run(
            [home / "bin" / "python", *pip, "--require-hashes", "-r", LOCK],
            check=True,
            timeout=INSTALL_LIMIT,
            stderr=subprocess.PIPE,
            text=True,
        )
    except (subprocess.SubprocessError, OSError) as error:
        shutil.rmtree(home, ignore_errors=True)
        reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines()[-1]
        raise FuzzError(f"{LOCK.name} cannot be installed: {reason}") from error
    return home / "bin" / "python"


@dataclass
class Run:
    """One running target."""

    target: str
    process: subprocess.Popen[bytes]
    log: Path
    failures: Path


def start(target: str, seconds: float, interpreter: Path, scratch: Path) -> Run:
    """Start one target for a number of seconds."""
    corpus, failures, log = OUT / "corpus" / target, scratch / f"{target}-", scratch / f"{target}.log"
    corpus.mkdir(parents=True, exist_ok=True)
    seeds = scratch / f"seeds-{target}"
    seeds.mkdir()
    for number, path in enumerate(sorted(FINDINGS.glob(f"{target}-*"))):
        shutil.copy(path, seeds / f"finding-{number}")
    for number, seed in enumerate(SEEDS.get(target, ())):
        (seeds / f"seed-{number}").write_bytes(seed)
    flags = {
        "max_total_time": max(1, round(seconds)),
        "max_len": LONGEST_INPUT,
        "timeout": SLOWEST_INPUT,
        "rss_limit_mb": MEMORY,
        "artifact_prefix": failures,
        "print_final_stats": 1,
    }
    paths = os.pathsep.join([str(ROOT), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    process = subprocess.Popen(
        [
            interpreter,
            "-c",
            PLAY,
            target,
            *(f"-{name}={value}" for name, value in flags.items()),
            corpus,
            seeds,
        ],
        stdin=subprocess.DEVNULL,
        stdout=log.open("wb"),
        stderr=subprocess.STDOUT,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": paths},
    )
    return Run(target, process, log, failures)


def finish(run: Run, limit: float) -> list[Path]:
    """Wait until a target ends, and store the inputs on which it failed where the tests find them.

    Raises:
        FuzzError: It ended for another reason.
    """
    code = run.process.wait(limit)
    lines = run.log.read_text(errors="replace").splitlines()
    done = next((line.split()[-1] for line in lines if "number_of_executed_units" in line), "?")
    kept = []
    for path in sorted(run.failures.parent.glob(f"{run.failures.name}*")):
        if path.is_dir() or path.suffix == ".log":
            continue
        data = path.read_bytes()
        FINDINGS.mkdir(exist_ok=True)
        finding = FINDINGS / f"{run.target}-{hashlib.sha256(data).hexdigest()[:12]}"
        finding.write_bytes(data)
        kept.append(finding)
    if kept:
        raised = next(
            (line.strip() for line in lines if "Error" in line or "exceeded" in line), "see its log"
        )
        print(f"FAIL {run.target}: {raised[:200]}")
        for finding in kept:
            print(f"    {finding.relative_to(ROOT)} ({finding.stat().st_size} bytes)")
        shutil.copy(run.log, OUT / f"{run.target}.log")
        print(f"    log: {(OUT / f'{run.target}.log').relative_to(ROOT)}")
    elif code != 0:
        raise FuzzError(f"target {run.target} ended with {code}: {' '.join(lines[-1:])[:300]}")
    else:
        print(f"ok  {run.target}: {done} inputs")
    return kept


def fuzz(targets: list[str], seconds: float) -> int:
    """Run all targets, one per processor at a time, and return exit code 1 if one failed."""
    interpreter = python()
    OUT.mkdir(parents=True, exist_ok=True)
    at_once = min(len(targets), os.cpu_count() or 1)
    each = seconds * at_once / len(targets)
    waiting, found = list(targets), 0
    running: list[tuple[Run, float]] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        try:
            while waiting or running:
                while waiting and len(running) < at_once:
                    running.append((start(waiting.pop(0), each, interpreter, Path(folder)), time.monotonic()))
                for run, begun in list(running):
                    late = time.monotonic() - begun > each + 60
                    if run.process.poll() is not None or late:
                        running.remove((run, begun))
                        if late:
                            run.process.kill()
                        found += len(finish(run, 10))
                time.sleep(0.2)
        finally:
            for run, _begun in running:
                run.process.kill()
                run.process.wait(10)
    return 1 if found else 0


def main() -> int:
    """Run the command."""
    parser = ScriptParser(
        prog="scripts/fuzz", description="Fuzz the codecs and the protocol cores of client and hub."
    )
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", help=f"one of {', '.join(TARGETS)} [default: all]"
    )
    parser.add_argument("--seconds", type=float, default=SECONDS, help="total duration in seconds")
    options = parser.parse_args()
    unknown = [target for target in options.targets if target not in TARGETS]
    if unknown:
        parser.error(f"{unknown[0]!r} is not a target; expected one of {', '.join(TARGETS)}")
    try:
        return fuzz(options.targets or list(TARGETS), options.seconds)
    except FuzzError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C)", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
