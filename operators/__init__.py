"""Blender's operators, one file each: they read the settings, start a task, and record its result."""

from __future__ import annotations

from typing import Any


def classes() -> tuple[type[Any], ...]:
    """Every operator, for registration. Imported here, because the package must import without Blender."""
    from . import (
        add_box,
        bake,
        cancel,
        estimate,
        export_scene,
        export_web,
        import_dataset,
        import_field,
        import_scene,
        open_folder,
        preview,
        quit,
        render_dataset,
        study,
        train,
        versions,
    )

    return (
        render_dataset.SNERG_OT_render_dataset,
        render_dataset.SNERG_OT_use_views,
        import_dataset.SNERG_OT_import_dataset,
        train.SNERG_OT_train,
        import_field.SNERG_OT_import_field,
        import_scene.SNERG_OT_import_scene,
        add_box.SNERG_OT_add_box,
        estimate.SNERG_OT_estimate,
        bake.SNERG_OT_bake,
        preview.SNERG_OT_preview,
        study.SNERG_OT_study,
        export_scene.SNERG_OT_export_scene,
        export_web.SNERG_OT_export_web,
        versions.SNERG_OT_use_version,
        versions.SNERG_OT_rename_version,
        versions.SNERG_OT_delete_version,
        versions.SNERG_OT_adopt_project,
        cancel.SNERG_OT_cancel,
        quit.SNERG_OT_quit,
        open_folder.SNERG_OT_open_folder,
    )
