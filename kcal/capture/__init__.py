"""Guided photography of a board: what to photograph next, until the camera is known well enough."""
