"""Scenes made linear about their present state: rendered components, products, least squares.

The start, finished fits, the test of colours and the weights of stars use many scenes at once, on
the device. linearised_scenes.py renders the components of all scenes in all observations and solves
for spectra; component_batch.py draws them in boxes, which render_planner.py and renderer.py render
in windows placed by placing.py, as the solver's; slot_observation.py sums their products over the
pixels of one observation; equations.py makes normal equations of the parameters from these sums;
rendered_models.py renders fixed morphologies and solves for their spectra.
Errors and joint steps use up to hundreds of modes of each component of one scene, on the host.
mode_images.py has their images, aligned_observation.py renders them, normal.py sums their products
in one matrix, and block_matrix.py factorises it. spectra.py solves for spectra, ties.py makes those
of one band equal.
Cost and memory are proportional to the number of components. Imports `resampling`, `device` and
`sky`, and of deblending views, profiles and component images; the solver, the start, refits and
errors import it.
"""
