"""Errors of fits with the multi-scale prior, marginalised over the morphologies.

About the solution everything is linear, in units of the noise and per channel c,

    d_c = sum_i R_c (dA_ic S_i + A_ic sum_k q_ik m_ik) + dsky_c + dR_c/dt . dt + noise,  q ~ N(0, 1)
    H = J^T J + prior^-1,                                           var(f) = grad f^T H^-1 grad f

with one matrix H a scene, in blocks of sources that meet. modes.py makes the images m_ik, from
smooth_modes.py and profile_modes.py; aligned_observation.py renders them from their boxes;
normal.py sums H and block_matrix.py factorises and inverts it; posterior.py derives errors from
it. bound_bias.py computes the bias from S >= 0 in fluxes and sizes: H^-1 times the gradient at the
bound. There, and only there, errors of sources that leave structure in the residuals, as
residuals.py measures it, are made larger; shared_light.py adds what the fit assumes of the division
of light between neighbours; errors.py is what a Result keeps, from which sampling.py
draws. Imports solver and sky, the profiles and views of deblending and what start/population.py
doubts, none of its fits.

Not in these errors, since no likelihood knows it: errors of the PSFs, of the model in bright
galaxies (Settings.flux_floor stands for both), and of the bounds of spectra at 0.
"""
