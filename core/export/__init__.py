"""Writes and reads baked scenes: scene folders, web pages, and the layout of the reference implementation."""
