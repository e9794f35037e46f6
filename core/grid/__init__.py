"""The baked scene: box, voxels, bake, march."""
