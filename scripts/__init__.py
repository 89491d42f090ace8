"""Scripts that measure kcal and write its pages; run one as `python -m scripts.ROOM.NAME` from the root."""
