"""Draw docs/hst_as_hsc.png: COSMOS galaxies of HST F814W as HSC sees them in i, beside HSC's own.

    CLRESAMPLE_DATA=folder python docs/hst_as_hsc.py

The two world coordinate systems disagree by about an HST pixel; the shift that correlates best is
fitted, as is one flux scale and sky level. The folder holds the cutouts and PSFs under hst_hsc/.
"""

import os
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from clresample import Resampler
from clresample.files.fits import read_image, read_psf
from clresample.files.plot_resampled import compare, plot_resampled

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("CLRESAMPLE_DATA") or HERE.parents[1] / "shared" / "data") / "hst_hsc"
I_BAND = 3  # of grizy


def main():
    hst = read_image(DATA / "hst_f814w.fits")
    hsc = read_image(DATA / "hsc_grizy.fits", bands=I_BAND)
    psf_hst = read_psf(DATA / "psf_hst_f814w.fits", center="core")
    psf_hsc = read_psf(DATA / "psf_hsc_grizy.fits", bands=I_BAND)
    op = Resampler(hst.grid, psf_hst, hsc.grid, psf_hsc)

    def distance(shift):
        op.shift = shift
        width = psf_hsc.fwhm_px[0]
        return -compare(op(hst.data)[0], hsc.data[0], op.covered, width).correlation

    start = {"initial_simplex": [(0, 0), (1, 0), (0, 1)], "xatol": 0.01, "fatol": 1e-6}
    shift = minimize(distance, np.zeros(2), method="Nelder-Mead", options=start).x
    op.shift = shift
    found = plot_resampled(
        HERE / "hst_as_hsc.png",
        hst,
        hsc,
        op(hst.data),
        op.covered,
        psf_hsc,
        names=("HST F814W", "HSC i"),
        title="One patch of COSMOS, two telescopes",
    )
    print(f"shift {shift.round(2)} HST pixels, correlation {found.correlation:.4f}")


if __name__ == "__main__":
    main()
