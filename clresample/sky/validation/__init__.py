"""Checks users' input where it comes in: every refusal is a ValueError that names it."""
