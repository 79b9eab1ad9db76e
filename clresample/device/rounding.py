"""Sizes rounded up to whole vectors, groups of work-items and blocks."""


def round_up(n, multiple):
    """The smallest multiple that is not below n; elementwise for an array."""
    return -(-n // multiple) * multiple
