"""One blend of many galaxies in Euclid and Rubin: fields beyond the stamps of the paper."""

from __future__ import annotations

import numpy as np

from clresample import Blend, ExtendedSource, Observation, model_frame
from clresample.simulation.galaxies import draw, random_galaxy
from clresample.simulation.scenes import (
    MAGNITUDE_RANGE,
    POWER_LAW_INDEX,
    RUBIN_WAVELENGTHS_NM,
    SMOOTHING_ARCSEC,
)
from clresample.simulation.structure import real_galaxy
from clresample.simulation.surveys import EUCLID_VIS, RUBIN_UGRIZY

ANGLE_DEG = 12.0  # Of Rubin's pixels to Euclid's: no survey's pixels are aligned with another's.
FILLED = 0.9  # Part of the field's side in which the galaxies' centres lie.
# [arcsec] Half side of the cutout on which a galaxy is drawn: ten half-light radii and more, beyond
# which light is under the noise.  Drawn on whole fields, hundreds of galaxies would take minutes.
REACH_ARCSEC = 6.0


def crowded_blend(seed, n_sources, n_model, sky="plain"):
    """Parametric galaxies at random places of a field, with their true positions.

    Magnitudes and colours are drawn as those of `simulate_scene`.

    sky: "real" for galaxies as of simulate_field's, to REACH_ARCSEC / 3
    n_model [px]: Euclid's pixels a side, on which the model lives
    returns Blend
    """
    rng = np.random.default_rng(seed)
    half_arcsec = FILLED * n_model * EUCLID_VIS.pixel_scale_arcsec / 2
    positions_arcsec = rng.uniform(-half_arcsec, half_arcsec, (n_sources, 2))
    galaxies = [random_galaxy(rng, smoothing_arcsec=SMOOTHING_ARCSEC) for _ in range(n_sources)]
    vis = rng.uniform(*MAGNITUDE_RANGE, (n_sources, 1))
    if sky == "real":
        galaxies = [real_galaxy(rng, float(mag[0]), REACH_ARCSEC / 3) for mag in vis]
    index = rng.normal(*POWER_LAW_INDEX, (n_sources, 1))
    colours = -2.5 * index * np.log10(RUBIN_WAVELENGTHS_NM)
    brightest = rng.uniform(*MAGNITUDE_RANGE, (n_sources, 1))
    ugrizy = colours - colours.min(axis=1, keepdims=True) + brightest
    euclid = EUCLID_VIS.grid(n_model)
    rubin = RUBIN_UGRIZY.grid(RUBIN_UGRIZY.n_same_sky(n_model, EUCLID_VIS), angle_deg=ANGLE_DEG)
    observations = tuple(
        _observe(survey, grid, galaxies, positions_arcsec, magnitudes, rng)
        for survey, grid, magnitudes in (
            (EUCLID_VIS, euclid, vis),
            (RUBIN_UGRIZY, rubin, ugrizy),
        )
    )
    places = euclid.pixel(*positions_arcsec.T)
    sources = tuple(ExtendedSource(position_px=tuple(map(float, place))) for place in places)
    return Blend(observations, sources, model_frame(observations, grid=euclid))


def _observe(survey, grid, galaxies, positions_arcsec, magnitudes, rng):
    """Images of a survey (C, Ny, Nx), each galaxy drawn on a cutout of the grid around it."""
    data = survey.noise_sigma[:, None, None] * rng.standard_normal((survey.n_bands, *grid.shape))
    reach_px = int(np.ceil(REACH_ARCSEC / survey.pixel_scale_arcsec))
    counts, top = survey.counts(magnitudes), np.array(grid.shape)
    for galaxy, position, flux in zip(galaxies, positions_arcsec, counts, strict=True):
        place = np.rint(grid.pixel(*position)).astype(int)
        low, high = np.clip(place - reach_px, 0, top), np.clip(place + reach_px + 1, 0, top)
        if not (high > low).all():  # in a corner that a turned image does not hold
            continue
        cutout = grid.cutout(*map(int, low), tuple(map(int, high - low)))
        for image, sigma, one in zip(data, survey.psf_sigma_arcsec, flux, strict=True):
            image[low[0] : high[0], low[1] : high[1]] += one * draw(
                galaxy, cutout, psf_sigma_arcsec=sigma, position_arcsec=position
            )
    variance = survey.noise_sigma**2
    return Observation(
        data,
        survey.psf(),
        grid,
        variance=variance,
        channels=survey.bands,
        zero_points=survey.zero_points_mag,
        name=survey.name,
    )
