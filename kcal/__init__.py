"""kcal: camera calibration and long-range stereo localisation for PyTorch."""

__version__ = "0.1.0"
