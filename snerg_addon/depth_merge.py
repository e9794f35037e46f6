"""The node group that lays two premultiplied renders over each other, at each pixel the nearer one in front.

Where an edge covers a part of a pixel, alpha over mixes; where two surfaces cross, the mixing follows how much of the pixel each one
is nearer in. So the colours of one render never mix with a background of the other: edges are soft and have no fringe.
"""

from __future__ import annotations

from typing import Any

import bpy

GROUP = "SNeRG Depth Merge"
VERSION = 1  # of the group's nodes; a group of another version is built again
BEFORE = 0.999  # of the depth where nothing is: surfaces are nearer than that
FILL = 3  # pixels round a surface that take its depth: the widest pixel filter of the engines reaches 1.5
INPAINT = 3  # pixels: from an edge pixel to the nearest whole one beyond the next, two pixels along a diagonal
JUMP = 1.5  # a depth that changes by less than this factor more in 5 x 5 than in 3 x 3 pixels jumps; on a plane it is 2
OPAQUE = 0.999  # alpha above is that of a pixel without background
TINY = 1e-9  # bounds a division by the difference of two equal depths; alpha below is 0
ROWS = 6  # nodes above each other in the group, in the order in which they are made
INPUTS = (("Image", "Color"), ("Alpha", "Float"), ("Depth", "Float"))
BAKED = tuple((f"Baked {name}", kind) for name, kind in INPUTS)


def group() -> bpy.types.NodeTree:
    """The node group, built where the file has none."""
    found = bpy.data.node_groups.get(GROUP)
    if found is None or found.library is not None:
        found = bpy.data.node_groups.new(GROUP, "CompositorNodeTree")
        add_sockets(found)
    if found.get("snerg_version") != VERSION:
        found.nodes.clear()
        build(Nodes(found))
        found["snerg_version"] = VERSION
    return found


def add_sockets(tree: bpy.types.NodeTree) -> None:
    """The group's inputs and outputs. Environment is added behind both renders; Opaque is 1 where that makes the picture opaque."""
    for name, kind in (*INPUTS, ("Environment", "Color"), ("Opaque", "Float"), *BAKED):
        socket = tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
        socket.default_value = (0.0, 0.0, 0.0, 0.0) if kind == "Color" else 0.0
    for name, kind in INPUTS:
        tree.interface.new_socket(name, in_out="OUTPUT", socket_type=f"NodeSocket{kind}")


def build(nodes: Nodes) -> None:
    """What the group computes, with m and b for the meshes' and the baked objects' render (premultiplied), a for alpha, d for depth:

    nearer = how much of a pixel d_m < d_b holds in; image = nearer (m over b) + (1 - nearer) (b over m) + (1 - a_b) environment.
    The environment pass holds what of the world the meshes leave visible, hence no factor 1 - a_m.
    """
    get = nodes.add("NodeGroupInput").outputs
    m, b = get["Image"], get["Baked Image"]
    ahead = nodes.math("SUBTRACT", nodes.filled(get["Baked Depth"], get["Baked Alpha"]), nodes.filled(get["Depth"], get["Alpha"]))
    front, nearer = nodes.front(m, get["Alpha"], ahead)
    merged = nodes.mix(nearer, nodes.over(b, m), nodes.over(front, b))
    seen = nodes.mix(1.0, get["Environment"], nodes.math("SUBTRACT", 1.0, get["Baked Alpha"]), "MULTIPLY")
    left = nodes.math("MULTIPLY", nodes.math("SUBTRACT", 1.0, get["Alpha"]), nodes.math("SUBTRACT", 1.0, get["Baked Alpha"]))
    alpha = nodes.math("MAXIMUM", nodes.math("SUBTRACT", 1.0, left), get["Opaque"])
    put = nodes.add("NodeGroupOutput").inputs
    nodes.link(nodes.with_alpha(nodes.mix(1.0, merged, seen, "ADD"), alpha), put["Image"])
    nodes.link(alpha, put["Alpha"])
    nodes.link(nodes.math("MINIMUM", get["Depth"], get["Baked Depth"]), put["Depth"])


class Nodes:
    """Builds nodes in a compositor tree, whatever Blender calls them. Values are sockets or numbers."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def add(self, *names: str) -> Any:
        """A node of the first of the types that this Blender has."""
        known = [name for name in names if hasattr(bpy.types, name)]
        usable = [name for name in known if not name.startswith("ShaderNode") or bpy.app.version >= (5, 0)]
        column, row = divmod(len(self.tree.nodes), ROWS)
        node = self.tree.nodes.new(usable[0])
        node.location = 200 * column, -220 * row
        return node

    def link(self, value: Any, socket: bpy.types.NodeSocket) -> None:
        """Give an input its value."""
        if isinstance(value, float | int):
            socket.default_value = value
        else:
            self.tree.links.new(value, socket)

    def math(self, operation: str, first: Any, second: Any, clamp: bool = False) -> bpy.types.NodeSocket:
        """An operation of two values."""
        node = self.add("ShaderNodeMath", "CompositorNodeMath")
        node.operation, node.use_clamp = operation, clamp
        self.link(first, node.inputs[0])
        self.link(second, node.inputs[1])
        return node.outputs[0]

    def mix(self, factor: Any, first: Any, second: Any, blend: str = "MIX") -> bpy.types.NodeSocket:
        """Two colours blended; alpha is the first's."""
        node = self.add("ShaderNodeMix", "CompositorNodeMixRGB")
        node.blend_type = blend
        sockets, output = node.inputs[:3], node.outputs[0]
        if node.bl_idname == "ShaderNodeMix":
            node.data_type, node.clamp_factor, node.clamp_result = "RGBA", False, False
            named = {socket.identifier: socket for socket in (*node.inputs, *node.outputs)}
            sockets, output = [named[name] for name in ("Factor_Float", "A_Color", "B_Color")], named["Result_Color"]
        for value, socket in zip((factor, first, second), sockets, strict=True):
            self.link(value, socket)
        return output

    def over(self, front: Any, back: Any) -> bpy.types.NodeSocket:
        """A premultiplied colour over another."""
        node = self.add("CompositorNodeAlphaOver")
        named = "Foreground" in node.inputs
        self.link(front, node.inputs["Foreground"] if named else node.inputs[2])
        self.link(back, node.inputs["Background"] if named else node.inputs[1])
        return node.outputs[0]

    def with_alpha(self, colour: Any, alpha: Any) -> bpy.types.NodeSocket:
        """A colour with another alpha, its other channels unchanged."""
        node = self.add("CompositorNodeSetAlpha")
        if "Type" in node.inputs:
            node.inputs["Type"].default_value = "Replace Alpha"
        else:
            node.mode = "REPLACE_ALPHA"
        self.link(colour, node.inputs["Image"])
        self.link(alpha, node.inputs["Alpha"])
        return node.outputs[0]

    def spread(self, value: Any, size: int) -> bpy.types.NodeSocket:
        """The largest value within `size` pixels; the smallest, where `size` is negative."""
        node = self.add("CompositorNodeDilateErode")
        if "Size" in node.inputs:
            node.inputs["Size"].default_value = size
        else:
            node.distance = size
        if "Type" not in node.inputs:
            node.mode = "STEP"
        self.link(value, node.inputs[0])
        return node.outputs[0]

    def filled(self, depth: Any, alpha: Any) -> bpy.types.NodeSocket:
        """A depth pass whose surfaces reach FILL pixels beyond their edges: a pixel whose centre misses an edge still has its depth.

        A pixel without a surface has the depth of those round it in which nothing is: Cycles gives 1e10, EEVEE the camera's clip end.
        """
        nearest = self.spread(depth, -FILL)
        nothing = self.spread(self.math("MULTIPLY", depth, self.math("LESS_THAN", alpha, TINY)), FILL)
        missed = self.math("GREATER_THAN", depth, self.math("MULTIPLY", nothing, BEFORE))
        partial = self.math("MULTIPLY", self.math("GREATER_THAN", nothing, 0.0), self.math("LESS_THAN", alpha, OPAQUE))
        return self.choose(self.math("MULTIPLY", missed, partial), nearest, depth)

    def change(self, value: Any, size: int) -> bpy.types.NodeSocket:
        """The largest less the smallest value within `size` pixels."""
        return self.math("SUBTRACT", self.spread(value, size), self.spread(value, -size))

    def choose(self, condition: Any, yes: Any, no: Any) -> bpy.types.NodeSocket:
        """`yes` where the condition is 1, `no` where it is 0; exact, as large as the two may be."""
        otherwise = self.math("MULTIPLY", no, self.math("SUBTRACT", 1.0, condition))
        return self.math("ADD", self.math("MULTIPLY", yes, condition), otherwise)

    def share_positive(self, ahead: Any) -> bpy.types.NodeSocket:
        """The share of each pixel in which a value that is linear over a pixel is positive, 0 to 1.

        Its change in the 3 x 3 pixels is twice |d/dx| + |d/dy|, so the share rises from 0 to 1 where the value is within half of that.
        """
        slope = self.math("DIVIDE", self.math("MULTIPLY", ahead, 2.0), self.math("MAXIMUM", self.change(ahead, 1), TINY))
        return self.math("ADD", slope, 0.5, clamp=True)

    def front(self, m: Any, alpha: Any, ahead: Any) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
        """The meshes' colour where they are in front of the baked objects, and the share of each pixel in which they are.

        ahead: how much nearer than the baked objects the meshes are. Where it changes its sign, either two surfaces cross, and it is
        linear; or it jumps at the edge of a mesh before another mesh, with a baked object between them: it changes by as much in 3 x 3
        as in 5 x 5 pixels. There pixels hold colours of the mesh behind, which would be a fringe. They get the colour of the mesh in
        front that is beside them, and a share by antialiasing the mask of the pixels in which a mesh is nearer.
        """
        nearer, opaque = self.math("GREATER_THAN", ahead, 0.0), self.math("GREATER_THAN", alpha, OPAQUE)
        inner, sign_changes = self.spread(nearer, -1), self.change(nearer, 1)
        jumps = self.math("LESS_THAN", self.change(ahead, 2), self.math("MULTIPLY", self.change(ahead, 1), JUMP))
        beside, known = self.inpainted(m, self.math("MULTIPLY", inner, opaque))
        edge = self.math("MULTIPLY", self.math("MULTIPLY", jumps, sign_changes), self.math("MULTIPLY", opaque, known))
        share = self.choose(edge, self.antialiased(nearer), self.share_positive(ahead))
        return self.mix(edge, m, beside), self.choose(sign_changes, share, nearer)

    def antialiased(self, mask: Any) -> bpy.types.NodeSocket:
        """A mask of 0 and 1 with soft edges."""
        node = self.add("CompositorNodeAntiAliasing")
        self.link(mask, node.inputs[0])
        return node.outputs[0]

    def inpainted(self, colour: Any, known: Any) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
        """A colour continued from where it is known (1; elsewhere 0) to INPAINT pixels beside; and where it then is known."""
        node, alpha = self.add("CompositorNodeInpaint"), self.add("CompositorNodeSeparateColor")
        if "Size" in node.inputs:
            node.inputs["Size"].default_value = INPAINT
        else:
            node.distance = INPAINT
        self.link(self.with_alpha(colour, known), node.inputs[0])
        self.link(node.outputs[0], alpha.inputs[0])
        return node.outputs[0], alpha.outputs["Alpha"]
