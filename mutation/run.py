"""`make mutation`: naive forms are put back, one at a time, and the tests that should see them run.

The lists are mutation/KIND.toml; mutations.py says what an entry holds. mutmut and cosmic-ray were looked at first: both exchange
operators and constants wherever they stand, and neither takes a list of lines with what to put there, nor shaders; hence this script.

Nothing in the working tree is changed: each of JOBS workers has a copy under build/mutation. This process imports pytest, NumPy and JAX
once and forks for every mutation; the project's own modules are imported in the fork, from the copy. A test that fails, a crash and a run
past its time limit kill a mutation. First all tests that are needed run without a mutation, and must pass.

    make mutation                        all
    make mutation KIND=losses,sampling   some lists
    make mutation NAME=losses/no-clamp   one
    make mutation PART=10 SEED=3         a tenth drawn with seed 3, without those that take minutes

Survivors are listed with file, line and reason. The last line counts; the exit code is 1 where fewer than 95 % are killed, 2 where the
lists are stale or a test fails without a mutation.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import py_compile
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mutations import ROOT, Mutation, faults, read_lists

BUILD = ROOT / "build" / "mutation"
KILLED = 0.95  # of the mutations, at least
PATIENCE = 60.0, 8.0  # seconds, and times as long as the tests take without a mutation: then a run hangs
PRELOADED = ("numpy", "scipy.optimize", "PIL.Image", "msgpack", "pytest", "jax", "jax.numpy", "optax")
COMPILED = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / "build" / "compiled"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}
Finish = Callable[[int, float], None]
SITE = """import importlib.util, sys
class Finder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        return importlib.util.spec_from_file_location(name, {init!r}, submodule_search_locations=[{tree!r}]) if name == "snerg" else None
sys.meta_path.insert(0, Finder)
"""


def main() -> None:
    args = arguments()
    everything = read_lists()
    if wrong := faults(everything, parsed=False):
        fail([*wrong, "The lists are stale: mend them."])
    chosen = choose(everything, args)
    if not chosen:
        fail(["No mutation is called that."])
    if wrong := faults(chosen):
        fail(wrong)
    BUILD.mkdir(parents=True, exist_ok=True)
    os.environ.update(COMPILED)
    preload()
    results: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="trees-", dir=BUILD, ignore_cleanup_errors=True) as folder:
        workers = [Worker(make_tree(Path(folder) / str(i))) for i in range(args.jobs)]
        try:
            seconds, passing = without_mutation(workers, chosen)
            results = mutate(workers, chosen, seconds, passing)
        except KeyboardInterrupt:
            print("Interrupted.")
            sys.exit(130)
        finally:
            for worker in workers:
                worker.stop()
    sys.exit(report(results))


def fail(sentences: Sequence[str]) -> None:
    print("\n".join(sentences), file=sys.stderr)
    sys.exit(2)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", default="", help="names of lists, with commas")
    parser.add_argument("--name", default="", help="KIND/NAME of mutations, with commas")
    parser.add_argument("--part", type=int, default=1, help="run one mutation in PART")
    parser.add_argument("--seed", default="0", help="any text, from which the part is drawn")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="workers (default: processors)")
    return parser.parse_args()


def choose(mutations: Sequence[Mutation], args: argparse.Namespace) -> list[Mutation]:
    """The mutations to run. Slow ones and those that are argued to survive are in no drawn part."""
    kinds, names = ({text for text in given.split(",") if text} for given in (args.kind, args.name))
    chosen = [m for m in mutations if (not kinds or m.kind in kinds) and (not names or m.title in names)]
    if args.part > 1:
        able = [m for m in chosen if not (m.slow or m.survives)]
        chosen = random.Random(args.seed).sample(able, -(-len(able) // args.part))
    return sorted(chosen, key=lambda m: (m.kind, m.name))


def preload() -> None:
    """Import what the forks share. JAX starts no threads before its first array, so that forking is safe."""
    for name in PRELOADED:
        try:
            __import__(name)
        except ImportError:  # the tests that want it are skipped, and say so
            print(f"{name} is not installed; tests that need it are skipped.")


def make_tree(tree: Path) -> Path:
    """A copy of the working tree, with the web viewer as it is built."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=ROOT, check=True, capture_output=True, text=True)
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file() and not (ROOT / name).is_symlink():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    if (ROOT / "viewer" / "dist").is_dir():
        shutil.copytree(ROOT / "viewer" / "dist", tree / "viewer" / "dist")
    if (ROOT / "node_modules").exists():
        (tree / "node_modules").symlink_to((ROOT / "node_modules").resolve())
    site = tree / "build" / "site"
    site.mkdir(parents=True)
    (site / "sitecustomize.py").write_text(SITE.format(init=str(tree / "__init__.py"), tree=str(tree)))
    # Compiled files that are compared by content: a mutation of the same length in the same second must not be passed over.
    compileall.compile_dir(tree, quiet=2, invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH)
    return tree


@dataclass
class Worker:
    """A copy of the tree, and the forked process in it. pid: 0 where there is none."""

    tree: Path
    pid: int = 0
    started: float = 0.0
    limit: float = 0.0
    finish: Finish = lambda code, seconds: None

    @property
    def outcomes(self) -> Path:
        """The file to which a run writes its tests' outcomes."""
        return self.tree.with_suffix(".json")

    def start(
        self, tests: Sequence[str], log: Path, limit: float, finish: Callable[[int, float], None], options: Sequence[str] = ()
    ) -> None:
        """Fork, and run tests in the fork; `finish` gets the exit code (-9: past the limit) and the seconds."""
        self.outcomes.unlink(missing_ok=True)
        log.parent.mkdir(parents=True, exist_ok=True)
        sys.stdout.flush()
        self.started, self.limit, self.finish = time.monotonic(), limit, finish
        self.pid = os.fork()
        if not self.pid:
            run_tests(self.tree, tests, log, self.outcomes, options)

    def poll(self) -> None:
        """Notice that the run ended, or end it."""
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        seconds = time.monotonic() - self.started
        if not pid and seconds < self.limit:
            return
        code = os.waitstatus_to_exitcode(status) if pid else -9
        self.stop(waited=bool(pid))
        self.finish(code, seconds)

    def stop(self, waited: bool = False) -> None:
        """End the run and all that it started."""
        if self.pid:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            if not waited:
                os.waitpid(self.pid, 0)
        self.pid = 0

    def read_outcomes(self) -> dict[str, list[str]]:
        """Of each test, without its parameters: its outcomes. Empty where the run crashed."""
        return json.loads(self.outcomes.read_text()) if self.outcomes.exists() else {}


class Outcomes:
    """A plugin of pytest that writes down how each test ended."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found: dict[str, list[str]] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.when == "call" or report.outcome != "passed":
            self.found.setdefault(report.nodeid.split("[")[0], []).append(report.outcome)

    def pytest_sessionfinish(self) -> None:
        self.path.write_text(json.dumps(self.found))


def run_tests(tree: Path, tests: Sequence[str], log: Path, outcomes: Path, options: Sequence[str]) -> None:
    """In the fork: run tests of a tree and end the process with pytest's exit code. Subprocesses see the tree's modules too."""
    code = 70
    try:
        os.setsid()
        target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(target, 1)
        os.dup2(target, 2)
        os.chdir(tree)
        os.environ["PYTHONPATH"] = str(tree / "build" / "site")
        exec((tree / "build" / "site" / "sitecustomize.py").read_text(), {})
        import pytest

        fixed = ["-q", "-p", "no:cacheprovider", "-m", "", "--durations=0", f"--rootdir={tree}", "-c", str(tree / "pyproject.toml")]
        code = int(pytest.main([*fixed, f"--basetemp={tree}.tmp", *options, *tests], plugins=[Outcomes(outcomes)]))
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def work(workers: Sequence[Worker], jobs: Iterator[Callable[[Worker], None]]) -> None:
    """Give jobs to free workers until all are done."""
    left = True
    while left or any(worker.pid for worker in workers):
        for worker in workers:
            if worker.pid:
                worker.poll()
            while left and not worker.pid:
                job = next(jobs, None)
                left = job is not None
                if job:
                    job(worker)
        time.sleep(0.02)


def without_mutation(workers: Sequence[Worker], chosen: Sequence[Mutation]) -> tuple[dict[str, float], set[str]]:
    """Run all tests that are needed. Returns the seconds of each file's tests, and the tests that passed; ends where one fails."""
    files: dict[str, set[str]] = {}
    for mutation in chosen:
        for test in mutation.tests:
            files.setdefault(test.split("::")[0], set()).add(test)
    seconds: dict[str, float] = {}
    passing: set[str] = set()
    failed: list[str] = []
    begun = time.monotonic()

    def job(file: str) -> Callable[[Worker], None]:
        log = BUILD / "logs" / "without" / (file.replace("/", "_") + ".log")

        def start(worker: Worker) -> None:
            def finish(code: int, spent: float) -> None:
                seconds[file] = spent
                ended = worker.read_outcomes()
                passing.update(test for test, outcomes in ended.items() if "passed" in outcomes)
                if code:
                    failed.append(f"Without a mutation the tests of {file} fail (exit code {code}): see {log.relative_to(ROOT)}.")

            worker.start(sorted(files[file]), log, 1800, finish)

        return start

    work(workers, iter([job(file) for file in sorted(files)]))
    if failed:
        fail(failed)
    print(f"{sum(map(len, files.values()))} tests pass without a mutation ({time.monotonic() - begun:.0f} s).", flush=True)
    return seconds, passing


@dataclass
class Result:
    """How a mutation ended. state: 'killed', 'survived' or 'not run'; by: the test that failed, or what happened."""

    mutation: Mutation
    state: str
    seconds: float = 0.0
    by: str = ""


def mutate(workers: Sequence[Worker], chosen: Sequence[Mutation], seconds: dict[str, float], passing: set[str]) -> list[Result]:
    """Run the tests of each mutation on a tree with it."""
    results: list[Result] = []

    def note(result: Result) -> None:
        results.append(result)
        count, title = f"{len(results):3d}/{len(chosen)}", result.mutation.title
        print(f"[{count}] {result.state:8s} {title:60s} {result.seconds:5.1f} s  {result.by}", flush=True)

    def job(mutation: Mutation) -> Callable[[Worker], None]:
        def start(worker: Worker) -> None:
            tests = [test for test in mutation.tests if test in passing]
            if not tests:
                return note(Result(mutation, "not run", by="its tests are skipped here"))
            path = worker.tree / mutation.file
            text = path.read_text()
            path.write_text(mutation.apply(text))
            built = rebuild(worker.tree, mutation)

            def finish(code: int, spent: float) -> None:
                path.write_text(text)
                if built:
                    rebuild(worker.tree, mutation)
                if code in (3, 4, 5, 70):  # pytest's own failures: wrong use, no test found
                    fail([f"{mutation.title}: pytest could not run (exit code {code}): see {log.relative_to(ROOT)}."])
                ended = worker.read_outcomes()
                by = next((test for test, outcomes in ended.items() if "failed" in outcomes), "")
                by = by.rpartition("/")[2] or {0: "", -9: "past its time limit"}.get(code, f"exit code {code}")
                note(Result(mutation, "killed" if code else "survived", spent, by))

            log = BUILD / "logs" / f"{mutation.title}.log"
            limit = PATIENCE[0] + PATIENCE[1] * sum(seconds[file] for file in {test.split("::")[0] for test in tests})
            worker.start(tests, log, limit, finish, ["-x"])

        return start

    work(workers, iter([job(mutation) for mutation in chosen]))
    return results


def rebuild(tree: Path, mutation: Mutation) -> bool:
    """Build the web viewer anew where the mutation is in it."""
    if not mutation.file.startswith("viewer/src"):
        return False
    subprocess.run(["node", "build.mjs"], cwd=tree / "viewer", check=True, stdout=subprocess.DEVNULL)
    return True


def report(results: Sequence[Result]) -> int:
    """Print the table and the survivors; the exit code."""
    print(f"\n{'kind':24s} {'all':>5s} {'killed':>7s} {'argued':>7s} {'survived':>9s}")
    for kind in sorted({result.mutation.kind for result in results}):
        of = [result for result in results if result.mutation.kind == kind and result.state != "not run"]
        alive = [result for result in of if result.state == "survived"]
        argued = sum(bool(result.mutation.survives) for result in alive)
        print(f"{kind:24s} {len(of):5d} {len(of) - len(alive):7d} {argued:7d} {len(alive) - argued:9d}")
    for result in results:
        mutation = result.mutation
        where = f"{mutation.file}:{mutation.line((ROOT / mutation.file).read_text())}"
        if result.state == "survived":
            why = f"argued: {mutation.survives}" if mutation.survives else f"survived: {mutation.why}"
            print(f"\n{where}: {mutation.title}\n    {why}")
        elif result.state == "killed" and mutation.survives:
            print(f"\n{where}: {mutation.title}\n    is argued to survive, but {result.by} sees it: take the argument out")
        elif result.state == "not run":
            print(f"\n{where}: {mutation.title}\n    not counted: {result.by}")
    ran = [result for result in results if result.state != "not run"]
    killed = sum(result.state == "killed" for result in ran)
    print(f"\nkilled {killed} of {len(ran)}")
    return 0 if ran and killed >= KILLED * len(ran) else 1


if __name__ == "__main__":
    main()
