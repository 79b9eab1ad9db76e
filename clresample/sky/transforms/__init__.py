"""Transforms of large images at frequencies that lie on no grid of theirs."""
