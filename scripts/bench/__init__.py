"""Benchmarks against other libraries, in ratios."""
