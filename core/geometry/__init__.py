"""Cameras, lenses, device coordinates and boxes."""
