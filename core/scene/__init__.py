"""The baked scene (SNeRG): block-sparse voxels and a small network."""
