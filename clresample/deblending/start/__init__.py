"""The start of fits: profiles, free stars and spectra, for all scenes of a group at once.

Fits call profile_start.py; first_scene.py makes a Scene from its result, in the boxes of boxes.py.
profile_fit.py takes Levenberg-Marquardt steps, from the expected profiles or those of an earlier
fit and, in scenes with large galaxies, from those of first_profiles.py; without_doubt.py and
close_pairs.py have further starts. The package `linear` renders the profiles and makes the normal
equations. By the products of alternatives.py shape_grid.py then sets size and wings of faint
galaxies, and wide_light.py adds second components; star_weights.py sets weights of bright stars,
carried_structure.py adds structure of an earlier fit.
"""
