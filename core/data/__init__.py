"""Datasets: views with their cameras, and the readers of captures."""
