"""Simulated fields as `run_field` takes them."""

import numpy as np

from clresample import Mosaic
from clresample.fields.psfs.sampled import ScatteredPSF


def mosaics_of(field):
    """The mosaics of a SimulatedField, in memory."""
    return tuple(
        Mosaic.of_arrays(
            m.survey.name,
            m.data,
            ScatteredPSF(m.psf_images, m.psf_positions),
            m.grid,
            weights=np.broadcast_to(m.noise_sigma[:, None, None] ** -2.0, m.data.shape),
            channels=m.survey.bands,
            zero_points=list(m.survey.zero_points_mag),
            mask=m.bad_pixels,
        )
        for m in field.mosaics
    )
