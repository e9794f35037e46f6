"""Send to Flamenco. A server on this machine answers as the Manager's API does, and compiles what it is sent by the Manager's rules."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import bpy
import pytest

from farm import a_manager, arguments
from scenes import make_snerg
from snerg.core.export.scene_files import write_scene
from snerg.operators.farm_frames import frame_numbers, is_whole
from snerg.snerg_addon import flamenco, preferences
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.scene_object import folder_of, make


@pytest.fixture
def chosen(preference):
    """Names a Manager in the preferences."""
    yield lambda url: preference("flamenco_url", url)
    flamenco.stop()


@pytest.fixture
def manager(chosen, tmp_path):
    with a_manager(tmp_path) as server:
        chosen(server.url)
        yield server


def answer():
    """What the Manager says of itself, when it has come."""
    end = time.monotonic() + 20
    while (said := flamenco.manager()).state == "asked" and time.monotonic() < end:
        time.sleep(0.01)
        flamenco.poll()
    return said


def send(**settings):
    return bpy.ops.snerg.send_to_flamenco(**settings)


def test_a_manager_is_found_and_asked_once(manager):
    began = time.monotonic()
    assert flamenco.manager().state == "asked" and time.monotonic() - began < 0.5, "the window does not wait"
    said = answer()
    assert said.state == "ready" and "Flamenco Manager 3.7" in said.text and flamenco.manager() is said
    manager.known = False
    flamenco.ask_again()
    said = answer()
    assert said.state == "unready" and str(flamenco.SCRIPT) in said.text and flamenco.SCRIPT.is_file()


@pytest.mark.parametrize("url", ["ftp://localhost:8080", "localhost:8080", "http://", "nonsense", "http://farm.example:8080"])
def test_an_address_where_no_manager_can_be_is_said(chosen, url):
    chosen(url)
    said = flamenco.manager()
    assert said.state == "absent" and ("is no address of a Flamenco Manager" in said.text or "Allow Online Access" in said.text)


def test_what_does_not_answer_is_said_within_the_limit(chosen, monkeypatch):
    monkeypatch.setattr(flamenco, "SECONDS", 0.3)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        chosen(f"http://127.0.0.1:{silent.getsockname()[1]}")
        assert "No Flamenco Manager answers" in answer().text
    flamenco.ask_again()
    assert "No Flamenco Manager answers" in answer().text, "nothing listens there any more"
    chosen("")
    assert flamenco.manager() is None
    with pytest.raises(RuntimeError, match="No Flamenco Manager is named"):
        send(work="STUDY")


@pytest.fixture
def shot(scene, tmp_path):
    """A saved file with a SNeRG object."""
    write_scene(make_snerg((34, 20, 20)), tmp_path / "scene")
    make(make_snerg((34, 20, 20)), tmp_path / "scene", scene.collection)
    scene.frame_start, scene.frame_end = 1, 20
    scene.render.filepath = "//pictures/shot_"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    yield
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)


def test_frames_are_sent_as_the_saved_file_has_them(manager, shot, tmp_path):
    assert send(work="FRAMES", chunk_size=8) == {"FINISHED"}
    ((job, made),) = manager.jobs
    assert job["name"] == "shot: frames 1-20" and bpy.data.filepath == str(tmp_path / "shot.blend")
    assert [task["name"] for task in made["tasks"]] == ["render-1-8", "render-9-16", "render-17-20", "check-frames"]
    line = arguments(made["tasks"][0]["commands"][0])
    assert line[line.index("--render-output") + 1] == str(tmp_path / "pictures" / "2026-01-31_120000" / "######")
    for wrong in ("x", "1-", "-3", "1-2-3"):
        with pytest.raises(RuntimeError, match="give frames such as"):
            send(work="FRAMES", frames=wrong)
    assert len(manager.jobs) == 1
    copy = Path(job["settings"]["blendfile"])
    assert copy.parent == project_of(bpy.context.scene).folder / "farm" and [copy] == list(copy.parent.iterdir())
    bpy.ops.wm.open_mainfile(filepath=str(copy))
    assert folder_of(bpy.data.objects["SNeRG"]).resolve() == tmp_path / "scene", "the copy finds what it shows"


def test_bakes_and_a_study_are_sent_with_the_panels_settings(manager, scene, tmp_path):
    with pytest.raises(RuntimeError, match="There is no field"):
        send(work="BAKES")
    project = project_of(scene)
    project.field.mkdir(parents=True)
    (project.field / "field.npz").touch()
    scene.snerg.samples, scene.snerg.refine, scene.snerg.resolution, scene.snerg.target_db = 4, False, 96, 30.0
    with pytest.raises(RuntimeError, match="are no resolutions"):
        send(work="BAKES", resolutions="big")
    assert send(work="BAKES", resolutions="128, 256") == send(work="STUDY", parts=8) == {"FINISHED"}
    (bakes, made), (study, measured) = manager.jobs
    assert bakes["settings"]["bakes"] == "001=128, 002=256"
    assert (project.folder / "scenes" / "002").is_dir(), "no other bake takes the version's number"
    line = arguments(made["tasks"][1]["commands"][0])
    assert line[3:] == ["bake", str(project.field), "--out", str(project.folder / "scenes" / "002"), *line[7:]]
    assert line[7:] == ["--resolution", "256", "--samples", "4", "--no-refine"]
    assert len(measured["tasks"]) == 9 and arguments(measured["tasks"][-1]["commands"][0])[-2:] == ["--target-db", "30"]
    assert study["settings"]["out"].startswith(str(project.studies))


def test_a_job_that_is_refused_leaves_no_version(manager, scene):
    project = project_of(scene)
    project.field.mkdir(parents=True)
    (project.field / "field.npz").touch()
    manager.known = False
    with pytest.raises(RuntimeError, match="does not know jobs of SNeRG; copy"):
        send(work="BAKES", resolutions="128")
    assert not list((project.folder / "scenes").iterdir()) and not manager.jobs


def test_paths_outside_of_the_shared_storage_are_said(manager, shot, capsys):
    manager.storage = "/somewhere/else"
    result = flamenco.submit(preferences.flamenco_url(), "x", {"work": "study", "field": "/a", "out": "/somewhere/else/b", "parts": 1})
    assert result["outside"] == ["/a"] and result["storage"] == "/somewhere/else"
    with pytest.raises(Exception, match="error compiling job: the setting 'field' is empty"):
        flamenco.submit(preferences.flamenco_url(), "x", {"work": "study", "parts": 1})


def test_whole_frames_are_kept_and_damaged_ones_deleted(scene, tmp_path):
    scene.render.filepath = str(tmp_path / "frames" / "######")
    scene.render.image_settings.file_format = "PNG"
    image = bpy.data.images.new("noise", 64, 64)
    image.pixels = [(i * 7919 % 1000) / 1000 for i in range(64 * 64 * 4)]
    paths = [Path(scene.render.frame_path(frame=number)) for number in (1, 2, 3)]
    for path in paths:
        image.save(filepath=str(path))
    paths[1].write_bytes(paths[1].read_bytes()[:-3000])
    paths[2].write_bytes(b"")
    assert [is_whole(path) for path in paths] == [True, False, False]
    with pytest.raises(RuntimeError, match=r"missing or damaged .*: 2, 3, 4; run their tasks again"):
        bpy.ops.snerg.farm_frames(frames="1-4", check=True)
    assert all(path.exists() for path in paths), "a check deletes nothing"
    assert bpy.ops.snerg.farm_frames(frames="1,3") == {"FINISHED"}
    assert [path.exists() for path in paths] == [True, True, False] and not scene.render.use_overwrite, "frame 2 is another task's"
    assert frame_numbers("3, 5-7,6") == [3, 5, 6, 7]
    scene.render.use_overwrite = True
