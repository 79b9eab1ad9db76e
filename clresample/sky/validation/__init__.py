"""Validates users' input: every error is a ValueError that names the argument."""
