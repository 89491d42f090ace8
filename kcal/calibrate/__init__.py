"""From observations to cameras and rigs (floor 3)."""
