"""The start of fits: profiles, free stars and spectra, for all scenes of a group at once.

Fits call profile_start.py; first_scene.py makes a Scene from its result, in the boxes of boxes.py.
profile_fit.py takes Levenberg-Marquardt steps, from the expected profiles or those of an earlier
fit and, in scenes with large galaxies, from those of first_profiles.py; the package `linear`
renders the profiles and makes the normal equations. Size and wings of faint galaxies are then set
by the grids of shape_grid.py, weights of bright stars by star_weights.py; carried_structure.py adds
structure of an earlier fit.
"""
