"""Simulated surveys, galaxies and scenes, with their truth. Imports `sky` alone."""
