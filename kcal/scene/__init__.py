"""Matches of the scene itself: what both cameras of a rig see, found without knowing what it is."""
