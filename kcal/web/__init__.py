"""Local pages: a socket of this machine alone, and a gate that only its own browser passes."""
