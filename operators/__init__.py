"""Blender's operators, one file each: they read the settings, start a task, and record its result."""

from __future__ import annotations

from typing import Any


def classes() -> tuple[type[Any], ...]:
    """Every operator, for registration. Imported here, because the package must import without Blender."""
    from . import (
        add_box,
        add_scene,
        ask_python,
        bake,
        cancel,
        composite,
        estimate,
        export_scene,
        export_vdb,
        export_web,
        import_dataset,
        import_field,
        import_scene,
        open_folder,
        pack_scene,
        preview,
        proxy,
        quit,
        render_dataset,
        resize_box,
        study,
        train,
        versions,
    )

    modules = (
        *(
            render_dataset,
            import_dataset,
            train,
            import_field,
            import_scene,
            add_box,
            resize_box,
            estimate,
            bake,
            add_scene,
            preview,
            study,
        ),
        *(composite, proxy),
        *(export_scene, export_web, export_vdb, pack_scene, versions, cancel, quit, open_folder, ask_python),
    )
    return tuple(value for module in modules for name, value in vars(module).items() if name.startswith("SNERG_OT_"))
