"""Where things are: light directions, lamps and their weighted sums, and the three landmarks that place the crop."""
