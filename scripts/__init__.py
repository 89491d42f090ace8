"""Scripts that measure kcal and write its pages; run one as `python -m scripts.ROOM.NAME` from the root.

bench: time and accuracy beside other libraries, as ratios.
check: coverage of intervals, many seeds, conformance.
paper: the paper's tables and figures, and its networks.
shared: pages, timing, memory, simulated views, rigs and data that several scripts use.
"""
