"""From a trained field to a baked scene."""
