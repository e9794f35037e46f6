"""The baked scene (SNeRG): a block-sparse voxel grid and a small view-dependence network."""
