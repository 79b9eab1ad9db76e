"""The start of fits: profiles, free stars and spectra, for all scenes of a group at once.

Fits call profile_start.py; first_scene.py makes a Scene from its result, in the boxes of boxes.py.
profile_fit.py takes Levenberg-Marquardt steps with the normal equations of equations.py, from the
expected profiles or those of an earlier fit and, in scenes with large galaxies, from those of
first_profiles.py. Size and wings of faint galaxies are then set by the grids of shape_grid.py,
weights of bright stars by star_weights.py; carried_structure.py adds structure of an earlier fit.
linearised_scenes.py renders the components in all observations and solves for spectra;
slot_observation.py sums products over the pixels of one observation on the device.
component_batch.py draws boxes, which render_planner.py and renderer.py render in the pixels that
their light reaches. final_render.py does the same for finished fits. Cost and memory are
proportional to the number of components.
"""
