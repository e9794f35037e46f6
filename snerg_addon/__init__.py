"""Blender's nouns: properties, panels, and the bridge between Blender's objects and core's."""


def register() -> None:
    """Register every class, the scene's property and the command, in an order in which each finds what it needs."""
    from . import registration

    registration.register()


def unregister() -> None:
    """The reverse of `register`; stops work that is under way."""
    from . import registration

    registration.unregister()
