"""Pictures of what was measured (floor 5)."""
