"""The start of fits: profiles, free stars and spectra, for all scenes of a group at once.

profile_start.py is what fits ask for, first_scene.py turns its answer into a Scene, in the boxes
of boxes.py. profile_fit.py steps (Levenberg-Marquardt) with the normal equations of equations.py;
linearised_scenes.py holds what all observations see of the components, and solves for spectra. Of
one observation, slot_observation.py has the device add up products over pixels; render_planner.py
and renderer.py bring boxes, which component_batch.py draws, to the pixels that their light reaches.
final_render.py looks at finished fits in the same way. Cost and memory follow the number of
components.
"""
