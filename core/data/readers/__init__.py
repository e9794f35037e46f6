"""Readers of captures, one a format."""
