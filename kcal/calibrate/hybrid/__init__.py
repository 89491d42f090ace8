"""Learned lens fields, and the choice between lens models on held-out views."""
