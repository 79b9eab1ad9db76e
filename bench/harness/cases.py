"""Survey cases of the benchmarks: stamps of one sky, rendered by the operator and by GalSim."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from clresample import Resampler
from clresample.simulation.galaxies import draw, import_galsim, open_catalogue, random_galaxy
from clresample.simulation.surveys import Survey

from .options import BadOption, data_folder

# [model pixels] Sigma of the Gaussian that band-limits a galaxy before it is drawn, so that the
# model stamp's pixels can hold it.
SMOOTHING_PX = 2.0
# GalSim pads an image to this many times its size; its sinc kernel, which never ends, is given that
# period too (left to itself it asks for FFTs of 49152 x 49152).
GALSIM_PADDING = 4


@dataclass(frozen=True)
class Case:
    """Stamps of one sky, a model stamp of survey_in and the stamp that survey_out sees of it.

    survey_in, survey_out: `Survey`s of one band
    n_model [px]: side of the model stamp; the observed one has `n_obs` pixels in the same sky
    angle_deg [deg]: of the observed stamp
    """

    survey_in: Survey
    survey_out: Survey
    n_model: int
    angle_deg: float = 0.0

    @property
    def n_obs(self):
        return self.survey_out.n_same_sky(self.n_model, self.survey_in)

    @cached_property
    def grid_in(self):
        return self.survey_in.grid(self.n_model)

    @cached_property
    def grid_out(self):
        return self.survey_out.grid(self.n_obs, angle_deg=self.angle_deg)

    def operator(self, scheme=Resampler, **options):
        """Ours, or the paper's scheme, from the model's PSF image to the observation's."""
        return scheme(
            self.grid_in, self.survey_in.psf(), self.grid_out, self.survey_out.psf(), **options
        )

    def draw(self, galaxy):
        """GalSim's direct drawings: the model stamp (float32, as given to all) and the truth."""
        model, truth = (
            draw(galaxy, grid, psf_sigma_arcsec=survey.psf_sigma_arcsec[0])
            for grid, survey in (
                (self.grid_in, self.survey_in),
                (self.grid_out, self.survey_out),
            )
        )
        return model.astype(np.float32), truth

    def galsim(self, interpolant="quintic", *, psf_images=True):
        """GalSim as a user and the paper call it: a function from model stamp to observed stamp.

        The stamp is interpolated, convolved with P2 and deconvolved from P1, and drawn; the PSFs'
        part is made here, once.
        interpolant: "quintic", GalSim's default, or "sinc", of stamps and PSF images
        psf_images: as ours is given them; False hands GalSim the PSFs' formulae instead
        """
        galsim = import_galsim()

        def profile(grid, image):
            n_y, n_x = image.shape
            period = GALSIM_PADDING * max(n_y, n_x) * grid.pixel_scale_arcsec
            sinc = {"_force_stepk": 2 * np.pi / period} if interpolant == "sinc" else {}
            image = galsim.Image(image, wcs=_jacobian(grid))
            return galsim.InterpolatedImage(image, x_interpolant=interpolant, **sinc)

        def psf(survey, grid):
            if psf_images:
                return profile(grid, survey.psf().images[0].copy())
            pixel = _jacobian(grid).toWorld(galsim.Pixel(1.0))
            return galsim.Convolve(galsim.Gaussian(sigma=survey.psf_sigma_arcsec[0]), pixel)

        psf_in, psf_out = psf(self.survey_in, self.grid_in), psf(self.survey_out, self.grid_out)
        difference = galsim.Convolve(galsim.Deconvolve(psf_in), psf_out)
        n_obs, wcs = self.n_obs, _jacobian(self.grid_out)

        def render(stamp):
            observed = galsim.Convolve(profile(self.grid_in, stamp), difference)
            image = galsim.ImageF(n_obs, n_obs, wcs=wcs)
            return observed.drawImage(image, method="no_pixel").array

        return render


def check_observed(case):
    """Raises BadOption for a case whose model stamp holds no whole observed pixel."""
    if case.n_obs == 0:
        raise BadOption(
            f"--sizes {case.n_model}: no observed pixel from {case.survey_in.name} to "
            f"{case.survey_out.name}"
        )


def _jacobian(grid):
    (y_row, y_col), (x_row, x_col) = grid.jacobian  # [arcsec/px]
    return import_galsim().JacobianWCS(x_col, x_row, y_col, y_row)


class Galaxies:
    """Galaxies for SDRs: the first of a COSMOS catalogue, or parametric ones where there is none.

    folder: of the catalogue; None looks in CLRESAMPLE_DATA and in the data folder by the checkout
    name: "COSMOS" or "parametric", for the record

    Raises BadOption where the folder holds no catalogue.
    """

    def __init__(self, folder=None):
        import_galsim()
        self.catalogue = None
        if folder is None:
            folder = data_folder() / "cosmos"
            folder = folder if folder.is_dir() else None
        if folder is not None:
            try:
                self.catalogue = open_catalogue(folder)
            except (ValueError, OSError) as error:
                raise BadOption(f"--catalogue: {error}") from error
        self.name = "parametric" if self.catalogue is None else "COSMOS"

    def take(self, i_galaxy, case):
        """Galaxy `i_galaxy`, turned at random, its band limited for the model pixels of `case`."""
        if self.catalogue is not None:
            i_row = i_galaxy % self.catalogue.nobjects
        return random_galaxy(
            np.random.default_rng(i_galaxy),
            catalogue=self.catalogue,
            i_galaxy=None if self.catalogue is None else i_row,
            smoothing_arcsec=SMOOTHING_PX * case.survey_in.pixel_scale_arcsec,
        )
