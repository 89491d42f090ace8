"""Many cameras from their images, in parallel, continued after an interruption."""
