"""Boards, detection, sub-pixel refinement and observation files (floor 2)."""
