"""The preference for the place of new projects: what a pattern gives, and what is wrong with a bad one."""

from __future__ import annotations

import os
import re
from pathlib import Path

import bpy
import pytest
from stage import a_version

from snerg.snerg_addon.folder_pattern import folder_of_pattern, problem
from snerg.snerg_addon.owner import assign_project, write_owner
from snerg.snerg_addon.project import project_of

BLEND = Path(os.path.abspath("/art/still life.blend"))


@pytest.mark.parametrize(
    ("pattern", "folder"),
    [
        ("", "/art/still life.snerg/Wide_Shot"),
        ("//snerg/{file}/{scene}", "/art/snerg/still life/Wide_Shot"),
        ("//../projects/{scene}", "/projects/Wide_Shot"),
        (" //{file} ", "/art/still life"),
        ("//{file", "/art/still life.snerg/Wide_Shot"),
    ],
)
def test_a_pattern_gives_a_folder(pattern, folder):
    assert folder_of_pattern(pattern, BLEND, "Wide Shot") == Path(os.path.abspath(folder))


def test_a_whole_path_is_taken_as_it_is(tmp_path):
    assert problem(f"{tmp_path}/{{scene}}") == ""
    assert folder_of_pattern(f"{tmp_path}/{{scene}}", BLEND, "Scene") == tmp_path / "Scene"


@pytest.mark.parametrize(
    ("pattern", "sentence"),
    [
        ("//snerg/{file", "has a brace without its partner"),
        ("//snerg/{user}", r"has \{user\} in it; only \{file\} and \{scene\} have a meaning"),
        ("//snerg/{file.__class__}", "only"),
        ("//snerg/{file!r}", "only"),
        ("//snerg/{}", "only"),
        ("snerg/{scene}", "begins nowhere; begin with // for the folder of the .blend file"),
        ("//what?/{scene}", "has a character that no folder's name may have"),
        ("//", "names no folder of its own"),
        ("//./", "names no folder of its own"),
    ],
)
def test_a_bad_pattern_gives_one_sentence(pattern, sentence):
    said = problem(pattern)
    assert re.search(sentence, said) and said.count(". ") == 0 and len(said) < 140, said


def test_new_projects_go_where_the_pattern_says_and_others_stay(scene, tmp_path, preference):
    scene.snerg.folder = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    before = project_of(scene)
    assign_project(scene)
    write_owner(before.folder, scene)
    a_version(before, "field", 30.0)
    preference("project_pattern", "//snerg/{file}/{scene}")
    assert project_of(scene).folder == before.folder == tmp_path / "old.snerg" / scene.name
    scene.snerg.folder = ""  # as after closing without saving: found by its place
    assert project_of(scene).folder == before.folder
    other = bpy.data.scenes.new("Other")
    assert project_of(other).folder == tmp_path / "snerg" / "old" / "Other"
    third = bpy.data.scenes.new("Other?")  # the same name as a folder
    assign_project(other)
    write_owner(project_of(other).folder, other)
    assert project_of(third).folder == tmp_path / "snerg" / "old" / "Other-2"
    preference("project_pattern", "//snerg/{file")
    assert project_of(third).folder == tmp_path / "old.snerg" / "Other"
