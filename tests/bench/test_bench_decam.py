"""DECam's exposures in the benchmark of real scenes: PSFs, scene files, figures."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table

pytest.importorskip("galsim")


def test_psfex_rows_are_read_as_psfex_files(data, tmp_path):
    """A file in PSFEx's own form, kept as a row: to the same PSFs."""
    from bench.harness.decam import PAIR
    from clresample.fields.psfs.psfex import PSFExPSF

    path = data / "decam_pair" / f"{PAIR}-psfex.fits"
    table, header = fits.getdata(path, 1, header=True)
    row = {key: [header[key]] for key in header if key.startswith("POL") or key == "PSF_SAMP"}
    row["psf_mask"] = np.array(table["PSF_MASK"])
    Table(row).write(tmp_path / "rows.fits")
    for place in ((100.0, 1900.0), (3000.0, 50.0)):
        expected = PSFExPSF(path).psf_at(*place).images[0]
        found = PSFExPSF(tmp_path / "rows.fits").psf_at(*place).images[0]
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_decam_scenes_are_files_of_the_same_sources(data, tmp_path):
    from bench.harness import decam

    paths = decam.scene_files(data, tmp_path)
    assert paths.keys() == {"decam_galaxy", "decam_star", "decam_pair", *decam.ORDERS}
    last = Table.read(tmp_path / "decam_galaxy-last" / "sources.ecsv")
    assert last["ra"][-1] == decam.GALAXY[0][0]
    assert "[detection]" in paths["decam_pair"].read_text()
    channels = [e.name for e in decam.exposures(data / "decam_star")]
    assert channels == ["g", "r", "z", "g1", "r1", "z1"]
    for one in decam.exposures(data / "decam_galaxy"):
        rim = one.image[:5][one.weight[:5] > 0]
        assert abs(np.median(rim)) < np.median(one.weight) ** -0.5
        assert decam.aperture(one) > 0


def test_decam_figures_are_those_of_the_galaxy(monkeypatch, tmp_path):
    from bench.harness import decam

    ra, dec = decam.GALAXY[0]
    galaxy = {"ra": ra + 1e-5, "dec": dec, "flux": 30.0, "flux_err": 1.0, "flags": 0}
    other = {"ra": ra + 1e-2, "dec": dec, "flux": 99.0, "flux_err": 1.0, "flags": 0}
    monkeypatch.setattr(decam, "exposures", lambda _: [SimpleNamespace(name="g")])
    monkeypatch.setattr(decam, "aperture", lambda _: 40.0)
    rows = [{"scene": "decam_galaxy-last", "band": "g", "sources": [other, galaxy]}]
    (figures,) = decam.compared(rows, tmp_path).values()
    assert figures == {"decam_galaxy-last, g": "0.750 +- 0.025"}


def test_what_a_catalogue_says_is_plain_numbers():
    from astropy import units as u

    from bench.harness.decam import measured

    table = QTable({"ra": [1.0, 2.0] * u.deg, "dec": [0, 0] * u.deg, "flags": [0, 64]})
    table["flux_g"], table["flux_err_g"] = [3, 4] * u.uJy, [1, np.nan] * u.uJy
    first, second = measured(table, "g")
    assert first == {"ra": 1.0, "dec": 0.0, "flags": 0.0, "flux": 3.0, "flux_err": 1.0}
    assert second["flags"] == 64
