"""How a minimum is found where there are several."""
