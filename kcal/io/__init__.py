"""kcal's camera and rig files, and foreign formats (floor 2)."""
