"""A small simulated field and one run over it, which the tests of whole runs compare with."""

import numpy as np
import pytest

from clresample import Mosaic, simulate_field
from clresample.fields.psfs.sampled import PSFCube
from clresample.fields.run import run_field


def mosaics_of(field):
    """The mosaics of a SimulatedField, in memory."""
    return tuple(
        Mosaic.of_arrays(
            m.survey.name,
            m.data,
            m.grid,
            PSFCube(m.psf_images, m.psf_positions),
            weights=np.broadcast_to(m.noise_sigma[:, None, None] ** -2.0, m.data.shape),
            channels=m.survey.bands,
            zero_points=list(m.survey.zero_points_mag),
            mask=m.bad,
        )
        for m in field.mosaics
    )


@pytest.fixture(scope="session")
def sky():
    """A field of some 15 sources, Rubin's i alone beside Euclid's VIS."""
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    given = {"rubin_bands": ("i",), "psf_variation": 0.1, "bad_columns": 1}
    return simulate_field(11, n_pixels=192, density=160, clustering=0.5, **given)


@pytest.fixture(scope="session")
def done(sky, tmp_path_factory):
    """The folder of a run over it with the default options, and what `run_field` returned."""
    folder = tmp_path_factory.mktemp("field")
    return folder, run_field(mosaics_of(sky), folder)
