"""A field to a baked scene."""
