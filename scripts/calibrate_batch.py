"""Calibrate many cameras at once; the same as `kcal batch`.

python scripts/calibrate_batch.py cameras/ --board 9x6 --square 25mm -o results
"""

from __future__ import annotations

import sys

from kcal.cli.main import main

if __name__ == "__main__":
    sys.argv.insert(1, "batch")
    main()
