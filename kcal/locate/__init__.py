"""From pixel pairs to positions on the Earth (floor 4)."""
