"""Marching rays through a baked scene, with NumPy alone."""
