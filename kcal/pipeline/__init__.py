"""From the boxes of a detector in two videos to pairs, tracks and streams of positions."""
