"""A small simulated field and one run over it, which the tests of whole runs compare with."""

import pytest

from clresample import simulate_field
from clresample.fields.run import run_field
from helpers.fields import mosaics_of


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
