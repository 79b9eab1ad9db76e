"""Sky position and orientation of the demonstration and the example."""

ANGLE_DEG = 20.0  # of Rubin's pixels against Euclid's
CENTER_DEG = 150.1, 2.2  # right ascension, declination
