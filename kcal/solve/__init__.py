"""Nonlinear least squares that knows nothing of cameras (floor 1)."""
