"""Coverage of error bars, many seeds, conformance."""
