"""Move a face of the box along its axis: by a distance, or by dragging the arrow on it."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations as values, hence no postponed evaluation here.

import bpy
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d
from mathutils import Matrix, Vector
from mathutils.geometry import intersect_line_line

from ..snerg_addon import estimate_panel
from ..snerg_addon.bridge import box_of, size_text
from .task_operator import redraw

FACES = tuple((f"{sign}{axis}", f"{sign}{axis}", f"The face that looks along {sign}{axis}") for sign in "+-" for axis in "XYZ")
THINNEST = 1e-3  # of a side, below which a face does not move towards the opposite one
SNAP = 10  # steps a side, while Ctrl is held


class SNERG_OT_resize_box(bpy.types.Operator):
    """Move a face of the box; the opposite one stays. Ctrl: in steps of a tenth of the side"""

    bl_idname = "snerg.resize_box"
    bl_label = "Resize Box"
    bl_options = {"REGISTER", "UNDO", "GRAB_CURSOR", "BLOCKING", "INTERNAL"}

    face: bpy.props.EnumProperty(name="Face", items=FACES, options={"SKIP_SAVE"})
    distance: bpy.props.FloatProperty(name="Distance", description="How far it moves outwards", subtype="DISTANCE", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a box whose transform may be changed."""
        box = box_of(context.scene)
        if box is None or box.library is not None or context.mode != "OBJECT":
            cls.poll_message_set("There is no box of this file; add one with Add Box, in Object Mode")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Move the face by `distance`."""
        box = scene_box(context)
        box.matrix_world = moved_face(box, self.face, self.distance)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Drag the face with the pointer."""
        if context.region_data is None:
            return self.execute(context)
        box = scene_box(context)
        self._before, self._line = box.matrix_world.copy(), face_line(box, self.face)
        self._start = self._along(context, event)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Follow the pointer until the button is let go; Esc puts the box back."""
        box = box_of(context.scene)
        if box is None:
            return self._end(context, {"CANCELLED"})
        if event.type in ("ESC", "RIGHTMOUSE"):
            box.matrix_world = self._before
            return self._end(context, {"CANCELLED"})
        if event.type == "LEFTMOUSE" and event.value == "RELEASE":
            return self._end(context, {"FINISHED"})
        if event.type in ("MOUSEMOVE", "LEFT_CTRL", "RIGHT_CTRL"):
            box.matrix_world = self._before
            self.distance = self._along(context, event) - self._start
            if event.ctrl:
                step = side_of(box, self.face) / SNAP
                self.distance = round(self.distance / step) * step
            box.matrix_world = moved_face(box, self.face, self.distance)
            context.area.header_text_set("   ".join((size_text(box, context.scene), *estimate_panel.lines(context))))
            redraw()
        return {"RUNNING_MODAL"}

    def _along(self, context: bpy.types.Context, event: bpy.types.Event) -> float:
        """Where the pointer's ray comes closest to the face's line, as the distance from the face; 0 where they are parallel."""
        centre, outwards = self._line
        pointer = event.mouse_region_x, event.mouse_region_y
        origin = region_2d_to_origin_3d(context.region, context.region_data, pointer)
        direction = region_2d_to_vector_3d(context.region, context.region_data, pointer)
        closest = intersect_line_line(centre, centre + outwards, origin, origin + direction)
        return 0.0 if closest is None else float((closest[0] - centre).dot(outwards))

    def _end(self, context: bpy.types.Context, result: set[str]) -> set[str]:
        context.area.header_text_set(None)
        redraw()
        return result


def scene_box(context: bpy.types.Context) -> bpy.types.Object:
    """The scene's box, which `poll` has found."""
    box = box_of(context.scene)
    assert box is not None
    return box


def axis_of(face: str) -> tuple[int, float]:
    """(axis, sign) of a face such as '-Y'."""
    return "XYZ".index(face[1]), -1.0 if face[0] == "-" else 1.0


def side_of(box: bpy.types.Object, face: str) -> float:
    """The length of the box across a face, world units."""
    return float(2 * box.empty_display_size * box.matrix_world.col[axis_of(face)[0]].to_3d().length)


def face_line(box: bpy.types.Object, face: str) -> tuple[Vector, Vector]:
    """(the centre of a face, its unit normal outwards), in world space."""
    axis, sign = axis_of(face)
    column = box.matrix_world.col[axis].to_3d()
    outwards = sign * column.normalized()
    return box.matrix_world.translation + sign * box.empty_display_size * column, outwards


def moved_face(box: bpy.types.Object, face: str, distance: float) -> Matrix:
    """The box's world matrix with a face moved outwards by `distance`, world units; the opposite face stays."""
    axis, _ = axis_of(face)
    side, (_, outwards) = side_of(box, face), face_line(box, face)
    new = max(side + distance, THINNEST * side)
    scale = Matrix.Identity(4)
    scale[axis][axis] = new / side if side else 1.0
    return Matrix.Translation(outwards * (new - side) / 2) @ box.matrix_world @ scale
