"""Errors of fits with the multi-scale prior, marginalised over the morphologies.

About the solution everything is linear, in units of the noise and per channel c,

    d_c = sum_i R_c (dA_ic S_i + A_ic sum_k q_ik m_ik) + dsky_c + dR_c/dt . dt + noise,  q ~ N(0, 1)
    H = J^T J + prior^-1,                                           var(f) = grad f^T H^-1 grad f

with one matrix H a scene, in blocks of overlapping sources. modes.py makes the images m_ik, from
smooth_modes.py and profile_modes.py; the package `linear` renders them from their boxes, sums H and
factorises it; posterior.py derives errors from it. bound_bias.py computes the bias from S >= 0 in
fluxes and sizes: H^-1 times the gradient at the bound. Only posterior.py widens the errors of
sources with structure in their residuals, as measured by residuals.py; shared_light.py adds the
assumptions of the fit on the division of light between neighbours. errors.py has the classes that a
Result stores; sampling.py draws from them.
Imports linear, solver and sky, the profiles and views of deblending and start/population.py, not
its fits.

These errors do not include errors of the PSFs and of the model in bright galaxies
(Settings.flux_error_floor accounts for both), nor the effect of the bounds of spectra at 0.
"""
