"""Simulated lenses, rigs and rendered boards with known truth (beside the house; imports floor 1 only)."""
