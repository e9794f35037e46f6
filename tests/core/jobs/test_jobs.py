"""Jobs as real processes: finished, failed, killed, hanging, out of memory, waiting, left by their starter and found again."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from snerg.core.errors import Cancelled, SnergError
from snerg.core.jobs import folder as folders
from snerg.core.jobs import runner
from snerg.core.jobs.runner import Job, start_command

ROOT = Path(runner.__file__).resolve().parents[2]
PATIENCE = 30.0  # seconds for what takes a fraction of one
HEARD = 3.0  # seconds in which a job ends that was told to stop; 0.2 where the machine has nothing else to do

LOAD = f"""
import importlib, importlib.util, json, os, signal, sys, time
spec = importlib.util.spec_from_file_location("launcher", {str(ROOT / "launcher.py")!r})
launcher = importlib.util.module_from_spec(spec)
spec.loader.exec_module(launcher)
launcher.load(launcher.Path({str(ROOT)!r}))
from pathlib import Path
from snerg.core.errors import SnergError
from snerg.core.jobs import protocol
from snerg.core.jobs.protocol import run_job
from snerg.core.jobs.runner import Job
"""
WORKS_ON = "for k in range(10**6): progress(0.5, 'working'); time.sleep(0.01)"
posix = pytest.mark.skipif(os.name != "posix", reason="a POSIX signal")


@pytest.fixture(autouse=True)
def nothing_runs_on(tmp_path: Path) -> Iterator[None]:
    """Stop all jobs at the end, which would outlive a failed test."""
    yield
    for lock in tmp_path.rglob(folders.LOCK):
        (lock.parent / folders.STOP).touch()


def source(work: str) -> str:
    """A program that runs `work` (the body of a function of `progress`) as a job."""
    body = "\n".join("    " + line for line in work.strip().splitlines())
    return f"{LOAD}\ndef work(progress):\n{body}\nsys.exit(run_job(work))"


def job(work: str) -> Job:
    return Job([sys.executable, "-c", source(work)])


def until(true: Callable[[], bool]) -> float:
    """Wait for a condition, and return how many seconds that took."""
    start = time.monotonic()
    while not true():
        assert time.monotonic() - start < PATIENCE
        time.sleep(0.01)
    return time.monotonic() - start


def works(child: Job) -> bool:
    return not child.poll() or child.text == "working"


def test_result_and_progress_arrive():
    said: list[tuple[float, str]] = []
    child = job("for k in range(5): progress(k / 5, f'step {k} \\u00e9'); time.sleep(0.05)\nreturn {'psnr': 31.5}")
    assert child.wait(lambda fraction, message: said.append((fraction, message)), interval=0.01) == {"psnr": 31.5}
    assert any(message.endswith("\u00e9") for _, message in said)


def test_a_note_does_not_hide_what_goes_on():
    said: list[str] = []
    child = job(
        "from snerg.core.progress import Note\nprogress(0.0, 'Compiling')\nprogress(0.0, Note('NDC: no.'))\ntime.sleep(1)\nreturn {}"
    )
    child.wait(lambda fraction, message: said.append(message))
    assert child.text == "Compiling" and child.notes == ["NDC: no."]
    assert said.count("NDC: no.") == 1 and said[-1] == "Compiling"


def test_stray_prints_do_not_break_the_protocol(tmp_path):
    work = "print('{\"error\": \"not ours\"}'); os.system('echo banner'); sys.stderr.write('x' * 300000)\nreturn {'fine': True}"
    child = Job([sys.executable, "-c", "print('a banner, and [')\n" + source(work)])
    assert child.begin(tmp_path, {}).wait() == {"fine": True}
    assert child.state == "done" and child.fraction == 1.0


def test_an_error_is_one_sentence():
    with pytest.raises(SnergError, match=r"^The box is flat\.$"):
        job("raise SnergError('The box is flat.')").wait()


def test_an_unforeseen_error_is_one_sentence_too(tmp_path):
    child = job("return {}['missing']").begin(tmp_path, {})
    with pytest.raises(SnergError, match=r"KeyError: 'missing'"):
        child.wait()
    assert any("Traceback" in line for line in child.log)


def test_out_of_memory_says_so():
    with pytest.raises(SnergError, match="not enough memory"):
        job("raise MemoryError").wait()


def test_cancel_is_heard(tmp_path):
    child = job(WORKS_ON).begin(tmp_path, {})
    until(lambda: works(child))
    child.cancel()
    assert child.cancelling
    assert until(lambda: not child.poll()) < HEARD
    assert child.state == "cancelled" and "Stopped as you asked" in child.error


def test_a_stubborn_job_ends_itself(tmp_path):
    child = job("progress(0, 'working'); time.sleep(60)").begin(tmp_path, {})
    until(lambda: works(child))
    child.cancel()
    with pytest.raises(Cancelled, match="not yet saved is lost"):
        child.wait()


@posix
def test_a_killed_job_ends_in_a_sentence():
    with pytest.raises(SnergError, match="memory ran out"):
        job("os.kill(os.getpid(), signal.SIGKILL)").wait()


def test_a_crash_ends_in_a_sentence():
    with pytest.raises(SnergError, match=r"code 7: last words"):
        job("sys.stderr.write('last words\\n'); sys.stderr.flush(); os._exit(7)").wait()


def test_a_job_that_is_stopped_after_its_result_has_a_result(tmp_path):
    work = "import atexit; atexit.register(time.sleep, 3); progress(0.5, 'working')\nreturn {'psnr': 30.0}"
    child = job(work).begin(tmp_path, {})
    until(lambda: '"result"' in (tmp_path / "jobs" / child.folder.name / folders.EVENTS).read_text())
    child.cancel()
    assert child.wait() == {"psnr": 30.0}


def test_progress_that_raises_stops_the_job(tmp_path):
    def stop(fraction: float, message: str) -> None:
        raise Cancelled("enough")

    child = job(WORKS_ON).begin(tmp_path, {}, attached=True)
    with pytest.raises(Cancelled, match="enough"):
        child.wait(stop)
    assert child.state == "cancelled"


def test_a_python_that_is_not_there_is_reported(tmp_path):
    with pytest.raises(SnergError, match="was not found"):
        start_command(["info", "."], python="/nowhere/python3")
    with pytest.raises(SnergError, match="Cannot start"):
        Job([os.path.join(os.sep, "nowhere", "python3")]).begin(tmp_path, {})
    assert folders.job_folders(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_reported(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SnergError, match="Cannot write"):
        job("return {}").begin(tmp_path / "file", {})


def test_the_launcher_runs_a_command(tmp_path):
    child = start_command(["info", str(tmp_path / "missing")]).begin(tmp_path, {})
    with pytest.raises(SnergError, match="missing"):
        child.wait()
    assert child.state == "failed", json.dumps(child.log)


def begun_elsewhere(project: Path, work: str, attached: bool, then: str) -> subprocess.Popen[bytes]:
    """Start another process that begins a job in `project` and then runs `then`."""
    arguments = f"[sys.executable, '-c', {source(work)!r}]"
    code = f"{LOAD}\nchild = Job({arguments}).begin(Path({str(project)!r}), {{'label': 'Training'}}, attached={attached})\n{then}"
    return subprocess.Popen([sys.executable, "-c", code])


def the_job(project: Path) -> Job:
    until(lambda: len(folders.job_folders(project)) == 1)
    return Job.found(folders.job_folders(project)[0])


def test_a_job_outlives_who_began_it_and_is_found_again(tmp_path):
    work = f"while not Path({str(tmp_path / 'go')!r}).exists(): progress(0.5, 'working'); time.sleep(0.01)\nreturn {{'psnr': 30.0}}"
    assert begun_elsewhere(tmp_path, work, attached=False, then="os._exit(0)").wait() == 0
    child = the_job(tmp_path)
    until(lambda: works(child))
    assert child.fraction == 0.5 and child.record["label"] == "Training" and folders.live_jobs(tmp_path) == [child.folder]
    (tmp_path / "go").touch()
    assert child.wait() == {"psnr": 30.0}
    assert Job.found(child.folder).wait() == {"psnr": 30.0}, "found after its end as well"
    assert folders.take(child.folder) and not folders.take(child.folder), "taken in once"


def test_a_job_that_was_found_is_cancelled_as_any(tmp_path):
    begun_elsewhere(tmp_path, WORKS_ON, attached=False, then="os._exit(0)").wait()
    child = the_job(tmp_path)
    until(lambda: works(child))
    child.cancel()
    assert Job.found(child.folder).cancelling
    assert until(lambda: not child.poll()) < HEARD
    assert child.state == "cancelled"


def test_a_job_whose_folder_is_deleted_ends(tmp_path):
    """As Blender deletes its temporary folder when it closes."""
    child = job(WORKS_ON).begin(tmp_path / "project", {})
    until(lambda: works(child))
    shutil.rmtree(tmp_path / "project")
    until(lambda: not child.poll())
    assert not (tmp_path / "project").exists()


@posix
def test_a_job_that_somebody_waited_for_ends_with_who_is_killed(tmp_path):
    parent = begun_elsewhere(tmp_path, WORKS_ON, attached=True, then="child.wait()")
    child = the_job(tmp_path)
    until(lambda: works(child))
    parent.kill()
    parent.wait()
    assert until(lambda: not child.poll()) < HEARD
    assert child.state == "cancelled"


@posix
def test_a_killed_job_is_seen_to_be_dead_by_whoever_looks(tmp_path):
    begun_elsewhere(tmp_path, WORKS_ON, attached=False, then="os._exit(0)").wait()
    child = the_job(tmp_path)
    until(lambda: works(child))
    os.kill(int((child.folder / folders.LOCK).read_text()), signal.SIGKILL)
    assert until(lambda: not child.poll()) < HEARD
    assert child.state == "failed" and "ended without a result (killed" in child.error
    assert folders.live_jobs(tmp_path) == []


def test_jobs_of_a_project_run_one_after_another(tmp_path):
    """Each job writes when it starts and when it ends; a waiting job reports which one it waits for."""
    log = tmp_path / "order"
    work = "with open({log!r}, 'a') as file: file.write('+{k} '); file.flush(); time.sleep(0.3); file.write('-{k} ')\nreturn {{}}"
    children = [job(work.format(log=str(log), k=k)).begin(tmp_path, {"label": f"Step {k}"}) for k in range(3)]
    until(lambda: not children[2].poll() or children[2].text.startswith("Waits"))
    assert children[2].text in ("Waits for Step 0", "Waits for Step 1")
    for child in children:
        child.wait()
    assert log.read_text().split() == ["+0", "-0", "+1", "-1", "+2", "-2"]


def test_who_waits_can_be_cancelled_and_who_fails_lets_the_next_go_on(tmp_path):
    go = tmp_path / "go"
    first = job(f"while not Path({str(go)!r}).exists(): time.sleep(0.01)\nraise SnergError('No luck.')").begin(tmp_path, {"label": "First"})
    second, third = (job("return {}").begin(tmp_path, {"label": name}) for name in ("Second", "Third"))
    until(lambda: not second.poll() or second.text == "Waits for First")
    second.cancel()
    assert until(lambda: not second.poll()) < HEARD
    assert second.state == "cancelled" and "before it began" in second.error
    assert third.poll()
    go.touch()
    with pytest.raises(SnergError, match="No luck"):
        first.wait()
    assert third.wait() == {}


def test_projects_do_not_wait_for_each_other(tmp_path):
    first = job(WORKS_ON).begin(tmp_path / "a", {})
    assert job("return {}").begin(tmp_path / "b", {}).wait() == {}
    assert first.poll()
    first.cancel()
    until(lambda: not first.poll())


def test_a_waiting_job_has_imported_nothing_heavy(tmp_path):
    first = job(WORKS_ON).begin(tmp_path, {"label": "First"})
    second = start_command(["info", str(tmp_path)]).begin(tmp_path, {})
    until(lambda: not second.poll() or second.text == "Waits for First")
    if Path("/proc/self/maps").exists():
        pid = (second.folder / folders.LOCK).read_text().strip()
        assert "PIL" not in Path(f"/proc/{pid}/maps").read_text()
    for child in (second, first):
        child.cancel()
        until(lambda child=child: not child.poll())


def test_old_folders_are_deleted_but_not_what_was_not_taken_in(tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "KEPT", 2)
    monkeypatch.setattr(folders, "STARTING_SECONDS", 0.0)
    made = [folders.new_job(tmp_path, {"label": str(k)}) for k in range(5)]
    for folder in made[1:]:
        folders.take(folder)
    folders.prune(tmp_path)
    assert folders.job_folders(tmp_path) == [made[0], *made[3:]]


def test_damaged_folders_are_no_reason_to_fail(tmp_path):
    folder = folders.new_job(tmp_path, {"label": "Training"})
    (folder / folders.RECORD).write_text("[" * 100000)
    (folder / folders.EVENTS).write_bytes(b'\xff\x00\n[1]\n{"progress": "x"}\n{"result": 3}\n{"progress"')
    assert folders.label_of(folder) == "another job" and not folders.is_alive(folder)
    child = Job.found(folder)
    assert not child.poll() and child.state == "failed"


def test_the_launcher_and_the_jobs_agree_on_their_variables():
    """The launcher defines the names again, because it runs before core can be imported."""
    spec = importlib.util.spec_from_file_location("launcher", ROOT / "launcher.py")
    launcher = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launcher)
    assert (launcher.IMPORT_PATH, launcher.JOB) == (runner.IMPORT_PATH, folders.VARIABLE)
