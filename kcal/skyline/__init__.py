"""Absolute attitude of cameras from the skyline of an image and a raster of the terrain."""
