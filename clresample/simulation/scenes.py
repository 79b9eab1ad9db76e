"""Simulates blended scenes of two telescopes, with their truth, as in the paper's tests.

The flat sky has its origin in the middle of every stamp; y [arcsec] points north and x west, so
that the stamps of a scene that is put on the celestial sphere show east to the left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..sky.grid import Grid
from ..sky.observation import Observation
from ..sky.psf import PSF
from .galaxies import draw, import_galsim, open_catalogue, random_galaxy
from .structure import real_galaxy
from .surveys import EUCLID_VIS, RUBIN_UGRIZY, Survey

MODEL_PSF_SIGMA_PX = 0.8  # the paper's minimal PSF, in pixels of the model frame
MAGNITUDE_RANGE = (20.0, 29.0)  # [mag] the paper's uniform range
SMOOTH_MAGNITUDE_RANGE = (
    20.0,
    25.5,
)  # [mag] of VIS with smooth spectra: detectable by both telescopes
CENTRAL_FRACTION = 2 / 3  # of a stamp's side: where galaxies are put
MAX_REAL_ARCSEC = 2.0  # [arcsec] half-light radius of a stamp's largest galaxy of a real sky
MAX_SOURCES = 10  # the paper's scenes hold 1 to 10 galaxies
# Gaussians of sigma 2 and 1 Euclid pixels, combined: they leave no light above Nyquist's limit
SMOOTHING_ARCSEC = np.hypot(2, 1) * EUCLID_VIS.pixel_scale_arcsec
# Colours where no table is given: mean and spread of the power law's index, fitted to CatSim's rows
POWER_LAW_INDEX = (1.3, 1.2)
RUBIN_WAVELENGTHS_NM = (367.0, 482.0, 622.0, 754.0, 869.0, 971.0)  # [nm] effective, u to y
# [nm] where Rubin's r, i and z divide VIS's 550 - 900 nm between them
VIS_EDGES_NM = (550.0, 691.0, 818.0, 900.0)


def _to_pixels(grid, positions_arcsec):
    """Flat-sky positions (..., 2) [arcsec] as (row, column) of a flat grid."""
    return np.linalg.solve(grid.jacobian, (positions_arcsec - grid.origin).T).T


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedImage:
    """Image of a scene of S sources by one instrument, with its truth.

    survey: the instrument
    grid, psf: its `Grid` and `PSF`
    data (C, Ny, Nx) [counts]: all sources and noise, the sky subtracted
    contributions (S, C, Ny, Nx) [counts]: each source alone, without noise
    truth (S, Ny, Nx) [1]: each source at unit flux under a Gaussian PSF of 0.8 pixels of this grid
        and its pixel: the perfect model on this grid
    magnitudes (S, C) [mag], counts (S, C) [counts]: of the whole sources, also beyond the stamp
    positions_px (S, 2) [px]: (row, column) of the sources
    """

    survey: Survey
    grid: Grid
    psf: PSF
    data: np.ndarray
    contributions: np.ndarray
    truth: np.ndarray
    magnitudes: np.ndarray
    counts: np.ndarray
    positions_px: np.ndarray

    def __repr__(self):
        n_y, n_x = self.grid.shape
        return f"SimulatedImage({self.survey.name} {' '.join(self.survey.bands)}, {n_y} x {n_x} px)"

    @property
    def weights(self):
        """(C, Ny, Nx) [1/counts^2]: inverse variance of the noise."""
        inverse = 1 / self.survey.noise_sigma**2
        return np.broadcast_to(inverse[:, None, None], self.data.shape).copy()

    def observation(self):
        """The image as an `Observation` for a fit."""
        return Observation(
            self.data,
            self.psf,
            self.grid,
            weights=self.weights,
            channels=self.survey.bands,
            zero_points=self.survey.zero_points_mag,
            name=self.survey.name,
        )

    def with_noise(self, rng):
        """The same image with other noise, drawn from `rng`."""
        sigma = self.survey.noise_sigma[:, None, None]
        noise = sigma * rng.standard_normal(self.data.shape)
        return replace(self, data=self.contributions.sum(axis=0) + noise)


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedScene:
    """A blend of S galaxies observed by Euclid and Rubin.

    seed: of the random numbers
    euclid, rubin: `SimulatedImage` of each; the Euclid grid is the one of joint models
    profiles (S): GalSim objects at unit flux, smoothed, centred on the origin
    galaxies (S): rows of the catalogue, or None for parametric galaxies
    positions_arcsec (S, 2) [arcsec]: (y, x) on the flat sky
    """

    seed: int
    euclid: SimulatedImage
    rubin: SimulatedImage
    profiles: tuple
    galaxies: tuple | None
    positions_arcsec: np.ndarray

    def __repr__(self):
        return (
            f"SimulatedScene(seed {self.seed}: {len(self)} galaxies; {self.euclid}, {self.rubin})"
        )

    def __len__(self):
        return len(self.positions_arcsec)

    @property
    def images(self):
        """(rubin, euclid)."""
        return self.rubin, self.euclid

    @property
    def positions_deg(self):
        """Right ascension and declination (S, 2) [deg] of the sources; None on a flat sky."""
        grid = self.euclid.grid
        return None if grid.is_flat else grid.sky(*self.euclid.positions_px.T).T


def observe(survey, grid, profiles, positions_arcsec, magnitudes, rng, *, center_deg=None):
    """One instrument's view of given sources, with the truth behind it.

        data = sum_s counts(m_s) profile_s * PSF * pixel + noise,    variance counts(sky) pixel^2

    survey: `Survey` with photometry
    grid: `Grid.flat` to observe on
    profiles (S): GalSim objects of unit flux, centred on the origin
    positions_arcsec (S, 2) [arcsec]: (y, x) of the sources on the flat sky
    magnitudes (S, C) [mag]: of each source in each band
    rng: `numpy.random.Generator` of the noise
    center_deg (2,) [deg]: put the flat sky's origin there, and give the image a celestial WCS
    returns SimulatedImage

    Raises ValueError for numbers of sources or bands that do not agree.
    """
    positions_arcsec, magnitudes = np.asarray(positions_arcsec), np.asarray(magnitudes, float)
    if positions_arcsec.shape != (len(profiles), 2):
        raise ValueError(
            f"positions_arcsec has shape {positions_arcsec.shape}, must be {(len(profiles), 2)}"
        )
    if magnitudes.shape != (len(profiles), survey.n_bands):
        raise ValueError(
            f"magnitudes has shape {magnitudes.shape}, must be {(len(profiles), survey.n_bands)}"
        )
    counts = survey.counts(magnitudes)
    sources = list(zip(profiles, positions_arcsec, strict=True))
    units = [
        [draw(source, grid, psf_sigma_arcsec=s, position_arcsec=p) for s in survey.psf_sigma_arcsec]
        for source, p in sources
    ]
    contributions = counts[:, :, None, None] * np.array(units)
    sigma = MODEL_PSF_SIGMA_PX * survey.pixel_scale_arcsec
    truth = [draw(source, grid, psf_sigma_arcsec=sigma, position_arcsec=p) for source, p in sources]
    if center_deg is None:
        grid_on_sky = grid
    else:
        wcs = grid.to_wcs(ra_deg=center_deg[0], dec_deg=center_deg[1])
        grid_on_sky = Grid.from_wcs(wcs, grid.shape)
    image = SimulatedImage(
        survey=survey,
        grid=grid_on_sky,
        psf=survey.psf(),
        data=contributions.sum(axis=0),
        contributions=contributions,
        truth=np.array(truth),
        magnitudes=magnitudes,
        counts=counts,
        positions_px=_to_pixels(grid, positions_arcsec),
    )
    return image.with_noise(rng)


def simulate_scene(
    seed,
    *,
    n_sources=None,
    catalogue=None,
    colours=None,
    angle_deg=0.0,
    flip=False,
    n_pixels=60,
    center_deg=None,
    sky="plain",
    spectra="independent",
):
    """Simulates a blend in Euclid (VIS) and Rubin (ugrizy); one seed gives one scene.

    Positions are uniform in the central two thirds of the stamp, VIS magnitudes uniform in 20 - 29;
    a row of colours is shifted so that its brightest Rubin band is uniform in 20 - 29. Galaxies,
    positions and magnitudes do not change with the angle and the flip, nor do the first sources
    with n_sources. Needs GalSim (the extra `sim`).

    seed: a whole number
    n_sources: how many galaxies; None draws 1 to 10
    catalogue: folder or open catalogue of COSMOS galaxies; None for bulge + disk + knots
    colours: table, or its path, with columns u_ab ... y_ab [mag]; None for power-law spectra
    angle_deg [deg], flip: turn Rubin's grid, mirror it; Euclid's stays
    n_pixels: Rubin pixels a side; Euclid has as many as the same sky holds
    center_deg (2,) [deg]: right ascension and declination of the centre; grids then have a WCS
    sky: "plain", or "real" for galaxies to 2 arcsec as of `simulate_field`, without a catalogue
    spectra: "independent", VIS and Rubin magnitudes drawn independently, as in the paper's tests;
        "smooth", one spectrum a galaxy: VIS follows from r, i and z, uniform in 20 - 25.5
    returns SimulatedScene: images with noise [counts], and the truth behind them

    Raises ValueError for bad numbers, sky, spectra or table; ImportError without GalSim.
    Source: section `Sect:real_images`, Table `tab:sim_param`.
    """
    streams = np.random.SeedSequence(seed).spawn(4)
    n_rng, rubin_rng, euclid_rng = (np.random.default_rng(s) for s in streams[:3])
    if n_sources is None:
        n_sources = int(n_rng.integers(1, MAX_SOURCES, endpoint=True))
    _check(n_sources, sky, catalogue, spectra)
    if catalogue is not None:
        catalogue = open_catalogue(catalogue)
    rows = None if colours is None else _colour_rows(colours, RUBIN_UGRIZY.bands)
    n_euclid = EUCLID_VIS.n_same_sky(n_pixels, RUBIN_UGRIZY)
    half_arcsec = CENTRAL_FRACTION * n_euclid * EUCLID_VIS.pixel_scale_arcsec / 2
    how = half_arcsec, catalogue, rows, sky, spectra
    drawn = _random_sources(streams[3].spawn(n_sources), *how)
    profiles, galaxies, positions, vis, ugrizy = drawn
    turned = RUBIN_UGRIZY.grid(n_pixels, angle_deg=angle_deg, flip=flip)
    euclid, rubin = (
        observe(survey, grid, profiles, positions, mags, rng, center_deg=center_deg)
        for survey, grid, mags, rng in (
            (EUCLID_VIS, EUCLID_VIS.grid(n_euclid), vis, euclid_rng),
            (RUBIN_UGRIZY, turned, ugrizy, rubin_rng),
        )
    )
    return SimulatedScene(
        seed=seed,
        euclid=euclid,
        rubin=rubin,
        profiles=profiles,
        galaxies=None if catalogue is None else galaxies,
        positions_arcsec=np.array(positions),
    )


def _check(n_sources, sky, catalogue, spectra):
    """Raises ValueError for invalid arguments of `simulate_scene`."""
    if n_sources < 1:
        raise ValueError(f"n_sources is {n_sources}, must be 1 or more")
    if sky not in ("plain", "real") or (sky == "real" and catalogue is not None):
        raise ValueError(f'sky is {sky!r}, must be "plain", or "real" without a catalogue')
    if spectra not in ("independent", "smooth"):
        raise ValueError(f'spectra is {spectra!r}, must be "independent" or "smooth"')


def _random_sources(streams, *how):
    """Draws of `_random_source` for each of these seeds, as five tuples (S)."""
    drawn = [_random_source(np.random.default_rng(stream), *how) for stream in streams]
    return zip(*drawn, strict=True)


def _random_source(rng, half_arcsec, catalogue, rows, sky, spectra):
    """One galaxy: its profile, row of the catalogue, position [arcsec], magnitudes of both surveys.

    half_arcsec [arcsec]: positions lie within as much of the centre, in y and in x
    catalogue: open, or None; rows (n, 6) [mag]: colours to choose from, or None
    """
    position = rng.uniform(-half_arcsec, half_arcsec, 2)
    is_smooth = spectra == "smooth"
    vis = rng.uniform(*(SMOOTH_MAGNITUDE_RANGE if is_smooth else MAGNITUDE_RANGE), 1)
    row = _power_law_colours(rng) if rows is None else rows[rng.integers(len(rows))]
    ugrizy = row - row.min() + rng.uniform(*MAGNITUDE_RANGE)
    if is_smooth:
        ugrizy = row - vis_magnitude(row) + vis
    i_galaxy = None if catalogue is None else int(rng.integers(catalogue.nobjects))
    if sky == "real":
        light = real_galaxy(rng, float(vis[0]), MAX_REAL_ARCSEC)
        light = import_galsim().Convolve(light, import_galsim().Gaussian(sigma=SMOOTHING_ARCSEC))
        return light, None, position, vis, ugrizy
    profile = random_galaxy(
        rng, catalogue=catalogue, i_galaxy=i_galaxy, smoothing_arcsec=SMOOTHING_ARCSEC
    )
    return profile, i_galaxy, position, vis, ugrizy


def vis_magnitude(ugrizy):
    """Euclid's VIS magnitude of sources of given Rubin magnitudes.

    The flux density of VIS is the mean of r, i and z. The weight of each is the number of photons
    of a flat f_nu in its part of VIS, the difference of ln(wavelength).

    ugrizy (..., 6) [mag]; returns (...) [mag]
    """
    widths = np.diff(np.log(VIS_EDGES_NM))
    fluxes = 10 ** (-0.4 * np.asarray(ugrizy, float)[..., 2:5])
    return -2.5 * np.log10(fluxes @ (widths / widths.sum()))


def _colour_rows(colours, bands):
    """(n, C) [mag] finite rows of a table, or of the file that holds it."""
    from astropy.table import Table

    table = Table.read(colours) if isinstance(colours, (str, Path)) else colours
    names = [f"{band}_ab" for band in bands]
    missing = [name for name in names if name not in table.colnames]
    if missing:
        raise ValueError(f"colours has no column {missing[0]}; it has {', '.join(table.colnames)}")
    rows = np.stack([np.asarray(table[name], float) for name in names], axis=-1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        raise ValueError(f"colours has no row with finite {', '.join(names)}")
    return rows


def _power_law_colours(rng):
    """(6,) [mag] of a spectrum f_nu ~ wavelength^beta, beta spread as in CatSim's galaxies."""
    beta = rng.normal(*POWER_LAW_INDEX)
    return -2.5 * beta * np.log10(np.array(RUBIN_WAVELENGTHS_NM) / RUBIN_WAVELENGTHS_NM[2])
