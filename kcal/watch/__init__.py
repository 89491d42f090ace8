"""The rig that watches itself: attitude of both cameras over time, with its standard deviation at each time."""
