"""What scripts share: pages, timing, memory, simulated views."""
