"""Transforms of large images at arbitrary frequencies."""
