"""One camera, from observations to a camera with error bars."""
