"""Lens models, cameras and rigs in pure torch (floor 1)."""
