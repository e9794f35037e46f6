"""SNeRG without Blender: capture, field, grid, export, study, jobs. Nothing here imports bpy."""
