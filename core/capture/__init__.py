"""Photographs and cameras: what a field is trained on."""
