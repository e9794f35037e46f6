"""The add-on apart from its operators: settings, panels, the project, and the conversion between Blender's data and core's."""


def register() -> None:
    """Register everything with Blender."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Undo `register`. Work inside Blender is cancelled; jobs continue."""
    from . import registration

    registration.unregister()
