"""Mutants of the modules that carry frames, each tried with the tests of its room (see scripts/mutants)."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import hashlib
import json
import os
import queue
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import coverage
import msgspec
import psutil

from scripts.mutation import contexts, warm
from scripts.mutation.mutants import Mutant, mutants
from scripts.running.flags import ScriptParser

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "out" / "mutants" / "results.jsonl"
EQUIVALENT = Path(__file__).with_name("equivalent.toml")
SAMPLE = 40
NEEDED = 0.9
FACTOR, LEAST_LIMIT = 5.0, 8.0
"""A test is stopped after `FACTOR` times its duration without a mutant, and `LEAST_LIMIT` seconds."""
QUICK: Final = 30
"""Number of the quickest tests that run before the others, because selecting hundreds takes long."""
ATTEMPTS = 3
"""Maximum number of attempts to see a test fail twice, because load or a signal can also fail it once."""
BASELINE_LIMIT = 1800.0
GRACE = 15.0
MARK = "ROSBAYES_MUTANT"
FROM_OUTSIDE = (-signal.SIGTERM, -signal.SIGKILL, -signal.SIGINT)
"""Exit codes of tests that were killed, and so have no result."""
Outcome = Literal["found", "timed out", "killed", "survived"]
"""Outcome of a mutant: a timeout counts as found, and `killed` is not a result."""
FOUND: Final = "found"
TIMED_OUT: Final = "timed out"
KILLED: Final = "killed"
SURVIVED: Final = "survived"
LineTests = dict[str, dict[int, list[str]]]
"""Names of tests by module and line."""
_BOARD = ("tests/pcie_shim",)
_MASTER = ("tests/services/master", "tests/services/boards", "tests/services/pipeline")
_CLIENT = ("tests/bridge/client", "tests/bridge/test_fake_rosbridge.py")
_STACK = ("tests/integration",)
MODULES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "pcie_shim/host/mini_cluster.py": (_BOARD, ()),
    "pcie_shim/host/driven_board.py": (_BOARD, ()),
    "pcie_shim/host/socket_link.py": (_BOARD, ()),
    "pcie_shim/board/emulated_board.py": (_BOARD, ()),
    "services/pipeline/frames.py": (_MASTER, _STACK),
    "services/pipeline/synchroniser.py": (_MASTER, _STACK),
    "services/pipeline/publisher.py": (_MASTER, _STACK),
    "services/pipeline/subscriber.py": (_MASTER, _STACK),
    "services/master/run.py": (_MASTER, _STACK),
    "services/master/flow.py": (_MASTER, _STACK),
    "services/master/peers.py": (_MASTER, _STACK),
    "bridge/client/session.py": (_CLIENT, ()),
}
"""Tests of each module: first those of which the ones that execute the mutated line run, then tests of processes."""


@dataclass(frozen=True)
class Result:
    """One mutant that was tried."""

    module: str
    digest: str
    line: int
    before: str
    after: str
    outcome: Outcome
    tests: int
    """Number of tests that execute the line."""
    seconds: float

    @property
    def key(self) -> tuple[str, str]:
        """The module and the digest of the mutated source."""
        return self.module, self.digest


class MutationError(Exception):
    """Raised when the tests fail without a mutant."""


class Tree:
    """A copy of the project in which one mutant at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._warm: Warm | None = None
        self._trusted: set[str] = set()
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            check=True,
            capture_output=True,
            timeout=60,
        ).stdout
        for name in listed.decode().split("\0"):
            if name and (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        if (ROOT / ".mypy_cache").is_dir():
            shutil.copytree(ROOT / ".mypy_cache", folder / ".mypy_cache")

    def tests_by_line(self, tests: tuple[str, ...], modules: list[str]) -> tuple[LineTests, dict[str, float]]:
        """Return the tests that execute each line of modules, and the seconds of each test.

        Raises:
            MutationError: They fail without a mutant.
        """
        data, measured = self._folder / "coverage", self._folder / "durations.json"
        include = ",".join(f"{self._folder}/{module}" for module in modules)
        measure = ["-m", "coverage", "run", "--append", f"--data-file={data}", f"--include={include}"]
        flags = ["-q", "-p", "no:cacheprovider", "-p", contexts.__name__]
        waiting = [name for name in tests if (self._folder / name).exists()]
        durations: dict[str, float] = {}
        for _ in range(2):  # those that fail, perhaps because of the load, are repeated
            code = self._run(
                [*measure, "-m", "pytest", *flags, *waiting],
                BASELINE_LIMIT,
                {contexts.DURATIONS: str(measured)},
            )
            if code is None or not measured.exists():
                raise MutationError(f"{' '.join(tests)} did not end within {BASELINE_LIMIT:g} s")
            passed, waiting = json.loads(measured.read_text(encoding="utf-8"))
            durations |= passed
            if code == 0:
                break
        else:
            raise MutationError(f"tests fail without a mutant, mend them first: {' '.join(waiting)}")
        lines = coverage.CoverageData(str(data))
        lines.read()
        return {module: lines.contexts_by_lineno(f"{self._folder}/{module}") for module in modules}, durations

    def _run(
        self, command: list[str], limit: float, variables: Mapping[str, str] = MappingProxyType({})
    ) -> int | None:
        """Return the exit code of a Python process, None if it did not end in time, and end all that it started."""
        mark = new_mark()
        process = subprocess.Popen(
            [sys.executable, *command],
            cwd=self._folder,
            env={**environment(self._folder, mark), **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            _end_all(process, mark)

    def outcome(
        self, group: tuple[str, ...], module: str, source: str, limits: Mapping[str, float]
    ) -> Outcome:
        """Try a mutated module with tests of a group, each of which has a time limit in seconds."""
        self._warmed(group)  # before the mutant is in place, which it would import
        for _ in range(ATTEMPTS):
            with self._mutated(module, source):
                first, test = self._attempt(group, module, limits)
                if first == SURVIVED:
                    return SURVIVED
                # a second failure of the same test shows that neither load nor a signal from outside was the cause
                repeated = {test: limits[test]} if test in limits else limits
                again, _ = self._attempt(group, module, repeated)
            if again != SURVIVED and first != KILLED != again and self._passes_unchanged(group, repeated):
                return again
        return SURVIVED

    def _passes_unchanged(self, group: tuple[str, ...], limits: Mapping[str, float]) -> bool:
        """Return whether tests pass here without a mutant, tried once."""
        if not self._trusted.issuperset(limits) and self._attempt(group, "", limits)[0] == SURVIVED:
            self._trusted.update(limits)
        return self._trusted.issuperset(limits)

    def _attempt(
        self, group: tuple[str, ...], module: str, limits: Mapping[str, float]
    ) -> tuple[Outcome, str]:
        """Return what tests find in a module ("" if none is mutated), and the test that was the last to begin."""
        code, test = self._warmed(group).attempt(str(self._folder / module) if module else "", limits)
        if code is None:
            return TIMED_OUT, test
        if code in FROM_OUTSIDE:
            return KILLED, test
        return (FOUND if code else SURVIVED), test

    def _warmed(self, group: tuple[str, ...]) -> Warm:
        """Return the process that has imported the tests of a group."""
        if self._warm is None or self._warm.group != group:
            self.close()
            self._warm = Warm(self._folder, group)
        return self._warm

    def close(self) -> None:
        """End the process that has imported the tests."""
        if self._warm is not None:
            self._warm.close()
            self._warm = None

    def passes_with(self, module: str, source: str, tests: Sequence[str]) -> bool:
        """Return whether tests of processes pass with a mutated module; a failure counts if it is repeated."""
        with self._mutated(module, source):
            command = ["-m", "pytest", *warm.FLAGS, *tests]
            return any(self._run(command, BASELINE_LIMIT) in (0, *FROM_OUTSIDE) for _ in range(2))

    def type_checks_with(self, module: str, source: str) -> bool:
        """Return whether mypy accepts a mutated module; a mistake that mypy finds cannot be merged either."""
        with self._mutated(module, source):
            return self._run(["-m", "mypy", module], BASELINE_LIMIT) != 1  # 2: mypy itself failed

    @contextmanager
    def _mutated(self, module: str, source: str) -> Iterator[None]:
        path = self._folder / module
        original = path.read_bytes()
        path.write_text(source, encoding="utf-8")
        try:
            yield
        finally:
            path.write_bytes(original)


def _end_all(process: subprocess.Popen[Any], mark: str) -> None:
    """End the tests, and kill processes that a mutant left behind."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(GRACE)
    _kill_marked(mark, spared=0)


def _kill_marked(mark: str, spared: int) -> int:
    """Kill the processes of a mark, and return their number."""
    killed = 0
    for other in psutil.process_iter():
        try:
            if other.pid != spared and other.environ().get(MARK, "").startswith(mark):
                other.kill()
                killed += 1
        except psutil.Error:
            continue
    return killed


def new_mark() -> str:
    """Return a value of `MARK` for a process and all that it starts."""
    return f"{_own_mark()}{time.monotonic_ns()}"


def _own_mark() -> str:
    """Return the beginning of all values of `MARK` of this run."""
    return f"{os.getpid()}-"


def environment(folder: Path, mark: str) -> dict[str, str]:
    """Return the environment of tests in a copy of the project."""
    return {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", MARK: mark}


class Warm:
    """A process that has imported a group of tests (see `scripts.mutation.warm`)."""

    def __init__(self, folder: Path, group: tuple[str, ...]) -> None:
        self.group = group
        self._mark = new_mark()
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                warm.__name__,
                *(name for name in group if (folder / name).exists()),
            ],
            cwd=folder,
            env=environment(folder, self._mark),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        if self._answer(BASELINE_LIMIT) != 0:
            raise MutationError(f"{' '.join(group)} cannot be collected")

    def attempt(self, path: str, limits: Mapping[str, float]) -> tuple[int | None, str]:
        """Return the exit code of tests, None after a time limit, and the test that was the last to begin."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"path": path, "limits": dict(limits)}) + "\n")
        self._process.stdin.flush()
        code, test = self._answer(BASELINE_LIMIT + sum(limits.values()))
        _kill_marked(self._mark, spared=self._process.pid)
        return code, test

    def _answer(self, limit: float) -> Any:
        assert self._process.stdout is not None
        if not select.select([self._process.stdout], [], [], limit)[0]:
            raise MutationError(f"the process that runs the tests did not answer within {limit:.0f} s")
        line = self._process.stdout.readline()
        if not line:
            raise MutationError("the process that runs the tests was ended")
        return json.loads(line)

    def close(self) -> None:
        """End it, and all that it has started."""
        _end_all(self._process, self._mark)


def known_results() -> dict[tuple[str, str], Result]:
    """Return the results of earlier runs; a later line replaces an earlier one, and others are left out."""
    if not RESULTS.exists():
        return {}
    found = []
    for number, line in enumerate(RESULTS.read_bytes().split(b"\n"), start=1):
        if not line:
            continue
        try:
            found.append(msgspec.json.decode(line, type=Result))
        except (msgspec.MsgspecError, UnicodeDecodeError):
            print(f"{RESULTS}:{number} is not a result; its mutant is tried again", file=sys.stderr)
    return {result.key: result for result in found}


def end_last_line() -> None:
    """Complete the last line of the results, so that the next one is not appended to a truncated one."""
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    with RESULTS.open("ab+") as file:
        if size := file.tell():
            file.seek(size - 1)
            if file.read() != b"\n":
                file.write(b"\n")


def equivalents() -> dict[tuple[str, str, str], str]:
    """Return the reasons why mutants cannot be found, by module and the line before and after."""
    entries = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8")).get("equivalent", [])
    return {(entry["module"], entry["before"], entry["after"]): entry["reason"] for entry in entries}


class Campaign:
    """All mutants of a run, divided over a number of copies of the project."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._modules: list[str] = [name for name in MODULES if _selected(name, options.only)]
        self._known = known_results()
        self._end = time.monotonic() + 60 * options.minutes
        self._sample = {
            name: list(mutants((ROOT / name).read_text(encoding="utf-8"), options.sample, options.seed))
            for name in self._modules
        }
        self._lock = threading.Lock()
        self._coverage: dict[tuple[str, ...], tuple[LineTests, dict[str, float]]] = {}
        self._failure: Exception | None = None
        self._stopped = False

    def run(self) -> None:
        """Try the mutants without a result, until the time is over.

        Raises:
            MutationError: The tests fail without a mutant.
        """
        waiting: queue.SimpleQueue[tuple[str, Mutant]] = queue.SimpleQueue()
        for task in self._tasks():
            waiting.put(task)
        end_last_line()
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            workers = [
                threading.Thread(target=self._work, args=(Path(folder, str(number)), waiting))
                for number in range(self._options.workers)
            ]
            for worker in workers:
                worker.start()
            try:
                for worker in workers:
                    worker.join()
            except KeyboardInterrupt:
                self._stopped = True
                while _kill_marked(_own_mark(), spared=0) or any(worker.is_alive() for worker in workers):
                    time.sleep(0.1)
                raise
        if self._failure is not None:
            raise self._failure

    def _tasks(self) -> Iterator[tuple[str, Mutant]]:
        for name, sample in self._sample.items():
            for mutant in sample:
                known = self._known.get((name, _digest(mutant)))
                if known is None or (self._options.again and known.outcome == SURVIVED):
                    yield name, mutant

    def _work(self, folder: Path, waiting: queue.SimpleQueue[tuple[str, Mutant]]) -> None:
        folder.mkdir()
        tree = Tree(folder)
        try:
            self._try_all(tree, waiting)
        except Exception as error:
            self._failure = error
        finally:
            tree.close()

    def _try_all(self, tree: Tree, waiting: queue.SimpleQueue[tuple[str, Mutant]]) -> None:
        while time.monotonic() < self._end and self._failure is None and not self._stopped:
            try:
                module, mutant = waiting.get_nowait()
            except queue.Empty:
                return
            self._try(tree, module, mutant)

    def _try(self, tree: Tree, module: str, mutant: Mutant) -> None:
        own, others = MODULES[module]
        by_line, seconds = self._measured(tree, own)
        first, last = statement_lines((ROOT / module).read_text(encoding="utf-8"), mutant.line)
        names = {name for line in range(first, last + 1) for name in by_line[module].get(line, ()) if name}
        quick_first = sorted(names, key=lambda name: seconds.get(name, 0.0))
        began = time.monotonic()
        limits = {name: LEAST_LIMIT + FACTOR * seconds.get(name, 0.0) for name in quick_first}
        outcome: Outcome = SURVIVED
        quickest, slower = quick_first[:QUICK], quick_first[QUICK:]
        if quickest:
            outcome = tree.outcome(own, module, mutant.source, {name: limits[name] for name in quickest})
        if outcome == SURVIVED and not tree.type_checks_with(module, mutant.source):
            outcome = FOUND
        if outcome == SURVIVED and slower:
            outcome = tree.outcome(own, module, mutant.source, {name: limits[name] for name in slower})
        if outcome == SURVIVED and others and not self._options.quick:
            outcome = SURVIVED if tree.passes_with(module, mutant.source, others) else FOUND
        if self._stopped:  # the tests were killed, which says nothing about the mutant
            return
        result = Result(
            module=module,
            digest=_digest(mutant),
            line=mutant.line,
            before=mutant.before,
            after=mutant.after,
            outcome=outcome,
            tests=len(names),
            seconds=round(time.monotonic() - began, 1),
        )
        with self._lock:
            self._known[result.key] = result
            with RESULTS.open("a", encoding="utf-8") as file:
                file.write(json.dumps(dataclasses.asdict(result)) + "\n")
            print(
                f"{result.outcome:9} {module}:{mutant.line} {mutant.before}  ->  {mutant.after}", flush=True
            )

    def _measured(self, tree: Tree, tests: tuple[str, ...]) -> tuple[LineTests, dict[str, float]]:
        """Return the tests of each line, measured when a group is first needed."""
        with self._lock:
            if tests not in self._coverage:
                modules = [module for module, (own, _others) in MODULES.items() if own == tests]
                print(
                    f"running {' '.join(tests)} once, to measure their lines and times ...", file=sys.stderr
                )
                self._coverage[tests] = tree.tests_by_line(tests, modules)
            return self._coverage[tests]

    def report(self) -> int:
        """Print each module's figures and survivors; return 1 if one found too few of its mutants."""
        reasons, code = equivalents(), 0
        for name, sample in self._sample.items():
            tried = [self._known[key] for each in sample if (key := (name, _digest(each))) in self._known]
            survivors = [result for result in tried if result.outcome == SURVIVED]
            same = [result for result in survivors if (name, result.before, result.after) in reasons]
            judged = len(tried) - len(same)
            found = judged - (len(survivors) - len(same))
            share = found / judged if judged else 1.0
            code |= share < NEEDED or len(tried) < len(sample)
            counted = Counter(result.outcome for result in tried)
            print(
                f"{name}: {found} of {judged} found ({share:.0%}), {counted[TIMED_OUT]} of them by time, "
                f"{len(same)} equivalent, {len(sample) - len(tried)} not tried"
            )
            for result in survivors:
                reason = reasons.get((name, result.before, result.after))
                print(
                    f"    {result.line}: {result.before}  ->  {result.after}"
                    + (f"  ({reason})" if reason else "")
                )
        return int(code)


def statement_lines(source: str, line: int) -> tuple[int, int]:
    """Return the first and last line of the innermost statement at a line; of a compound one, those of its header.

    A function has all its lines, because the tests that use its defaults do not execute its header.
    """
    around = [(line, line)]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno or node.lineno
            if node.lineno <= line <= last:
                is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
                around.append((node.lineno, node.end_lineno or last if is_function else last))
    return min(around, key=lambda lines: (lines == (line, line), -lines[0]))


def _selected(name: str, words: list[str]) -> bool:
    return not words or any(word in name for word in words)


def _digest(mutant: Mutant) -> str:
    """Return a hash of the mutated code, which stays the same if docstrings or comments change."""
    tree = ast.parse(mutant.source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [each for each in node.body if not _is_text(each)]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16]


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def main() -> int:
    """Parse the flags, try the mutants and report."""
    parser = ScriptParser(
        prog="scripts/mutants",
        description="Try one-line mistakes, each of which the tests must find.",
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="WORD",
        help="only modules whose path contains WORD; repeatable",
    )
    parser.add_argument("--sample", type=int, default=SAMPLE, help="mutants per module")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample")
    parser.add_argument(
        "--minutes", type=float, default=240.0, help="time limit in minutes; the next run continues"
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=os.cpu_count() or 1,
        shown="one per CPU",
        help="number of mutants tried at the same time",
    )
    parser.add_argument("--quick", action="store_true", help="without the tests of processes")
    parser.add_argument("--again", action="store_true", help="try survivors of earlier runs again")
    options = parser.parse_args()
    for word in options.only:
        if not any(_selected(name, [word]) for name in MODULES):
            parser.error(f"--only {word}: no module's path contains it; the modules are {', '.join(MODULES)}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    campaign = Campaign(options)
    try:
        campaign.run()
    except MutationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted (Ctrl-C); the same command continues", file=sys.stderr)
        return 130
    return campaign.report()


if __name__ == "__main__":
    sys.exit(main())
