"""Starting point of a fit: smooth profiles and positions of free stars, fitted to all data.

Gauss-Newton on the shapes with the spectra eliminated (variable projection), over every channel of
every instrument, so that a source detected by a single instrument starts correctly:

    min  sum_pixels w (d - sum_s A_s R S_s)^2 - 2 sum contamination ln p(theta),    A >= 0

The prior p on theta, and the factor `contamination` for sources with neighbours, are in
population.py. Residuals of smooth profiles are a tenth of a bright galaxy's light. The weights
include them, 1/w = sigma^2 + (MODEL_ERROR * light)^2, so that profiles of faint neighbours are not
fitted to its spiral arms. The light is that of the smoothed data, so that weights do not depend on
the profiles: with weights from the model, chi2 would decrease with the flux of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np

from ...resampling.gridding import KaiserBessel
from ...resampling.plan import Precision
from ...sky.frame import Frame
from ...sky.sources import ExtendedSource, PointSource, is_open
from ..linear.component_batch import StartComponent, renumbered
from ..linear.linearised_scenes import linearise
from ..profiles import FixedProfile, GalaxyProfile, StarProfile, components_of
from ..sampled_psf import sampled_psfs
from ..view import WhitenedView, pixel_noise
from .first_profiles import NEED
from .profile_fit import CHI2_TOL, MAX_GROWTH, ProfileFit, growth, start_from
from .star_weights import allow_for_psf_error
from .wide_light import n_bands, points_in_wide_light, second_profiles

# Precision for smooth profiles, whose errors are a tenth of a galaxy's light. Omitting frequencies
# and light of the PSF below these fractions, with six taps, changes chi2 by 1e-4. With the
# operator's own precision and reach, the start takes three times as long.
PRECISION, TOLERANCE = Precision(1e-4, KaiserBessel(6, 1.5)), 1e-4
# [sigma] Smallest signal to noise of light at a source: noise reaches it once in 740 times; sources
# of `detect` have 5. A source is far from any light if neither its expected profile reaches this,
# nor a profile NEARBY times larger (a sigma of 1.5"). The second test spares faint sources beside
# others, which are probably real.
LIGHT_SIGMAS, NEARBY = 3.0, 6.0


@dataclass(frozen=True, eq=False)
class StartInput:
    """Inputs of the start of one scene.

    frame: Frame; sources (S), positions (S, 2) [px]: those inside it; views: WhitenedViews
    thetas (S): for each source None, or the parameters (n,) of each of its components, from which
        it starts; (): None for all
    observations: those of the views, for the PSFs of stars; (): stars of the model's PSF alone
    given: numbers of the sources that are as the user listed them
    """

    frame: Frame
    sources: list
    positions: np.ndarray
    views: list[WhitenedView]
    thetas: tuple = ()
    observations: tuple = ()
    given: tuple = ()


@dataclass(frozen=True, eq=False)
class StartingPoint:
    """Components of a scene before their own structure is fitted.

    source (n): the source of each component
    positions (S, 2) [px]: of the sources, for free stars the fitted ones
    undetected (S,): bool, sources far from any light, see `_is_dark`
    shapes (n): the components' ComponentProfiles; thetas (n): arrays of their parameters
    drawn_positions (n, 2) [px]: where the shapes are drawn with these parameters
    peaks (n,): by which profiles of unit integral are divided, so that max = 1
    spectra (n, C), sky (C,): least squares for these profiles; spectrum_curvature (n, C): sum u^2
        of each one's whitened image u. In the views' units
    flux_estimate (S, 3, C), flux_doubt (S, C, k): of the sources' fluxes, by size and wings of each
        alone, and k changes of all of them by the division of light in pairs, or by galaxies in
        place of points; see ProfileFit
    not_points {source: gain in chi2}: point sources that are better as galaxies
    """

    source: np.ndarray
    positions: np.ndarray
    undetected: np.ndarray
    shapes: list
    thetas: list
    drawn_positions: np.ndarray
    peaks: np.ndarray
    spectra: np.ndarray
    sky: np.ndarray
    spectrum_curvature: np.ndarray
    flux_estimate: np.ndarray = field(default_factory=lambda: np.zeros((1, 3, 1)))
    flux_doubt: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 0)))
    not_points: dict = field(default_factory=dict)

    def __len__(self):
        return len(self.shapes)

    def fluxes(self, shape):
        """Fluxes (S, C) of the sources in a frame of this shape, in the views' units."""
        found = np.zeros((len(self.positions), self.spectra.shape[1]))
        for i, spectrum in enumerate(self.spectra):
            found[self.source[i]] += spectrum * self.drawn(i, (0, 0), shape).sum()
        return found

    def stars(self):
        """Point sources, a list of (StarProfile, its source, position (2,) [px], spectrum (C,))."""
        spectra = self.spectra / self.peaks[:, None]
        rows = zip(self.shapes, self.source, self.positions[self.source], spectra, strict=True)
        return [row for row in rows if isinstance(row[0], StarProfile)]

    def drawn(self, i, origin, size):
        """Component i's profile in a box of the frame, (ny, nx)."""
        image = self.shapes[i].draw_box(
            self.thetas[i], self.drawn_positions[i], origin, size, slopes=False
        )
        return image[0] / self.peaks[i]

    def reach(self, i, threshold):
        """Middle (2,) and half size (2,) [px] of component i above a fraction of its peak."""
        return self.shapes[i].bounding_box(self.thetas[i], self.drawn_positions[i], threshold)


def fit_start_profiles(
    patches: list[StartInput], *, fit_sky=False, tol=CHI2_TOL, second=False
) -> list[StartingPoint]:
    """Fits profiles and free stars of all patches side by side; see the module's text.

    patches: of equal numbers of observations, these of equal shapes
    fit_sky: also a level per channel; tol: see ProfileFit
    second: give galaxies second components for far wider light and cores, see wide_light.py
    """
    return _started(patches, fit_sky, tol, second)[0]


def _started(patches, fit_sky, tol, second):
    """The StartingPoints and chi2 (B,) of patches, see `fit_start_profiles`."""
    fit, points = _fitted(patches, fit_sky, tol)
    chi2 = fit.chi2_at_end.copy()
    several = _with_second_components(patches, fit, points) if second else {}
    if several:
        again = _started(list(several.values()), fit_sky, tol, second)
        for b, point, lower in zip(several, *again, strict=True):
            if lower < chi2[b] - NEED - n_bands(fit.looking):
                points[b] = replace(point, undetected=points[b].undetected)
                chi2[b] = lower
    galaxies = _with_galaxies(patches, fit) if tol < NEED else {}
    if galaxies:
        others = _started([patch for _, patch in galaxies.values()], fit_sky, tol, second)
        for (b, (changed, patch)), other, lower in zip(galaxies.items(), *others, strict=True):
            if lower < chi2[b] - NEED - n_bands(fit.looking):
                points[b] = _doubting(points[b], other, patch, changed, chi2[b] - lower)
    return points, chi2


def _with_galaxies(patches, fit):
    """{scene: (sources (k,), its StartInput with these as galaxies)} of given points in wide light.

    See wide_light.py; fit: the ProfileFit that has ended, to a smaller tolerance than NEED.
    """
    thetas, galaxies = fit.thetas(), {}
    for i, c in enumerate(fit.looking.components):
        if c.source in patches[c.scene].given and isinstance(c.shape, StarProfile):
            shape, place = (
                GalaxyProfile(patches[c.scene].frame),
                c.shape.center(thetas[i], c.position),
            )
            galaxies[i] = replace(c, shape=shape, position=place)
    found: dict[int, list] = {}
    for i in points_in_wide_light(fit, galaxies):
        found.setdefault(galaxies[i].scene, []).append(i)
    inputs = {}
    for b, chosen in found.items():
        sources, positions = list(patches[b].sources), patches[b].positions.copy()
        changed = [galaxies[i].source for i in chosen]
        for i, s in zip(chosen, changed, strict=True):
            positions[s] = galaxies[i].position
            sources[s] = ExtendedSource(position_px=tuple(map(float, positions[s])))
        known = [None if s in changed else theta for s, theta in enumerate(patches[b].thetas)]
        given = {"sources": sources, "positions": positions, "thetas": tuple(known), "given": ()}
        inputs[b] = changed, replace(patches[b], **given)
    return inputs


def _doubting(point, other, patch, changed, gain):
    """The StartingPoint whose flux_doubt has the changes to another one, better by a gain in chi2.

    patch, changed (k,): as in `_with_galaxies`, of the other one
    """
    change = other.fluxes(patch.frame.shape) - point.fluxes(patch.frame.shape)
    doubt = np.concatenate([point.flux_doubt, change[..., None]], axis=2)
    return replace(point, flux_doubt=doubt, not_points=dict.fromkeys(changed, float(gain)))


def _fitted(patches, fit_sky, tol):
    """The ProfileFit of patches that has ended, and its StartingPoints."""
    sources, components = _components(patches)
    views = [p.views for p in patches]
    looking = linearise(views, components, PRECISION, TOLERANCE, fit_sky=fit_sky)
    noise = np.array([pixel_noise(p.views) for p in patches])
    fit = ProfileFit(looking, noise, tol)
    fit.begin()
    dark = _dark(patches, sources, looking)
    start_from(fit, _known(patches, components))
    fit.run()
    thetas = fit.thetas()
    looking.render(np.arange(len(patches)), thetas, fit.brightness, slopes=False)
    looking.solve(0.0)
    return fit, [_point(patch, fit, thetas, sources, b, dark[b]) for b, patch in enumerate(patches)]


def _with_second_components(patches, fit, points):
    """{scene: its StartInput with second components} of a ProfileFit, see wide_light.py.

    Others that have grown, and whose shapes its errors may feign, begin anew.
    """
    components = fit.looking.components
    free = [is_open(patches[c.scene].sources[c.source]) for c in components]
    found = second_profiles(fit, np.array(free))
    if not found:
        return {}
    scenes, inputs = np.unique(fit.looking.scene[list(found)]), {}
    feigned = (fit.measure_contamination(scenes) > NEED) & (growth(fit)[scenes] > MAX_GROWTH)
    for b, anew in zip(scenes.tolist(), feigned, strict=True):
        begin, sources = points[b], list(patches[b].sources)
        thetas: list = [[] for _ in sources]
        for i, theta, again in zip(begin.source, begin.thetas, anew[: len(begin)], strict=True):
            if not again:
                thetas[i].append(theta)
        for i, theta in found.items():
            if components[i].scene == b:
                own = components[i].source
                sources[own] = replace(sources[own], n_components=2)
                thetas[own].append(theta)
        inputs[b] = replace(patches[b], sources=sources, thetas=tuple(thetas), given=())
    return inputs


def with_psf_error_weights(patch, point: StartingPoint, settings):
    """Views with the PSF's error in bright stars in their weights; the start solved with these."""
    views = allow_for_psf_error(patch.frame, patch.views, point.stars(), settings.psf_error)
    if all(new is old for new, old in zip(views, patch.views, strict=True)):
        return patch.views, point
    return views, _solved_again(replace(patch, views=views), point, settings.fit_sky)


def _solved_again(patch, point, fit_sky):
    """The StartingPoint with spectra, sky and curvature solved again for the patch's views."""
    rows = enumerate(zip(point.source, point.shapes, point.drawn_positions, strict=True))
    components = [StartComponent(0, i, *row, patch.frame.shape) for i, row in rows]
    looking = linearise([patch.views], components, PRECISION, TOLERANCE, fit_sky=fit_sky)
    noise = pixel_noise(patch.views)
    brightness = (point.spectra / noise).max(axis=1)
    looking.render(np.arange(1), point.thetas, brightness, slopes=False)
    looking.solve(0.0)
    power = np.diagonal(looking.normal[0], axis1=1, axis2=2)[:, : len(point)].T
    return replace(
        point,
        spectra=looking.spectra * point.peaks[:, None],
        sky=looking.sky[0].copy(),
        spectrum_curvature=power / point.peaks[:, None] ** 2,
    )


def _point(patch, fit, thetas, sources, b, dark):
    """The StartingPoint of scene b from a ProfileFit, solved without errors of the models."""
    looking = fit.looking
    at = np.flatnonzero(looking.scene == b)
    chosen, own, positions = [looking.components[i] for i in at], [], patch.positions.astype(float)
    peaks = np.zeros(len(at))
    for k, (i, c) in enumerate(zip(at, chosen, strict=True)):
        own.append(thetas[i])
        positions[sources[i]] = c.shape.center(thetas[i], c.position)
        center = positions[sources[i]]
        peaks[k] = profile_peak(c.shape, thetas[i], c.position, center, c.frame)
    power = np.diagonal(looking.normal[b], axis1=1, axis2=2)[:, : len(at)].T
    n_sources = len(patch.sources)
    estimate, doubt = (
        np.zeros((n_sources, *values.shape[1:])) for values in (fit.flux_estimate, fit.flux_doubt)
    )
    np.add.at(estimate, sources[at], fit.flux_estimate[at])
    np.add.at(doubt, sources[at], fit.flux_doubt[at])
    return StartingPoint(
        source=sources[at],
        positions=positions,
        undetected=dark,
        shapes=[c.shape for c in chosen],
        thetas=own,
        drawn_positions=np.array([c.position for c in chosen]),
        peaks=peaks,
        spectra=looking.spectra[at] * peaks[:, None],
        sky=looking.sky[b].copy(),
        spectrum_curvature=power / peaks[:, None] ** 2,
        flux_estimate=estimate,
        flux_doubt=doubt[..., doubt.any(axis=(0, 1))],
    )


def profile_peak(shape, theta, place, center, frame):
    """The largest pixel of a ComponentProfile's profile of unit integral in its frame.

    place (2,) [px]: the profile's position; center (2,) [px]: where the largest pixel is searched,
        within 2 px; frame (2,) [px]: shape of the frame
    """
    if isinstance(shape, FixedProfile):
        return shape.peak
    middle, top = np.floor(center + 0.5).astype(int), np.array(frame)
    low, high = np.maximum(middle - 2, 0), np.minimum(middle + 3, top)
    return float(shape.draw_box(theta, place, low, high - low, slopes=False).max())


def _components(patches):
    """Sources (N,) in their patches, and StartComponents of all patches."""
    sources, components = [], []
    for b, patch in enumerate(patches):
        n = 0
        for i, (source, position) in enumerate(zip(patch.sources, patch.positions, strict=True)):
            place, sampled = np.array(position, dtype=np.float64), ()
            if isinstance(source, PointSource):
                sampled = sampled_psfs(patch.frame, patch.observations, place)
            for shape in components_of(source, patch.frame, sampled):
                components.append(StartComponent(b, n, i, shape, place, patch.frame.shape))
                sources.append(i)
                n += 1
    return np.array(sources), components


def by_size(thetas):
    """Numbers of a source's components of parameters `thetas` (n), the most compact one first."""
    return sorted(range(len(thetas)), key=lambda k: tuple(thetas[k][:1]))


def _known(patches, components):
    """Parameters {component: (n,)} of `StartInput.thetas`, of sources with as many components.

    Of several the most compact one is first, as in `components_of`.
    """
    known: dict[int, np.ndarray] = {}
    numbers = range(len(components))
    for (b, i), own in groupby(numbers, lambda k: (components[k].scene, components[k].source)):
        given = patches[b].thetas[i] if len(patches[b].thetas) else None
        places, before = list(own), () if given is None else list(given)
        before = [before[k] for k in by_size(before)]
        sizes = [len(components[k].shape.mean) for k in places]
        if [len(theta) for theta in before] == sizes:
            known |= dict(zip(places, before, strict=True))
    return known


def _dark(patches, sources, looking):
    """Selects sources far from any light: (S,) bool of each patch.

    looking: LinearisedScenes of all components with their expected profiles, sky levels solved for
    sources (N,): the source of each component
    """
    seen, found = looking.signal_to_noise(looking.sky), []
    for b, patch in enumerate(patches):
        at = looking.scene == b
        snr = np.full((len(patch.sources), seen.shape[1]), -np.inf)
        np.maximum.at(snr, sources[at], seen[at])
        found.append(_is_dark(snr))
    again = [(b, i) for b, dark in enumerate(found) for i in np.flatnonzero(dark)]
    if again:
        wide = []
        for b, i in again:
            frame, position = patches[b].frame, np.array(patches[b].positions[i], float)
            shape = GalaxyProfile(frame, widened=NEARBY)
            wide.append(StartComponent(b, 0, i, shape, position, frame.shape))
        wide = renumbered(wide)
        around = looking.with_components(wide)
        scenes = np.unique(around.scene)
        around.render(scenes, [c.shape.mean for c in wide], np.zeros(len(wide)), slopes=False)
        dark = _is_dark(around.signal_to_noise(looking.sky))
        for (b, i), still in zip(again, dark, strict=True):
            found[b][i] = still
    return found


def _is_dark(snr):
    """Selects positions (n,) without light, from their signal to noise (n, C).

    Tested are each channel, and the equally weighted sum of all channels that cover the position,
    which detects sources that are faint in each of many channels.
    """
    n_seen = np.maximum(np.count_nonzero(snr, axis=1), 1)
    together = snr.sum(axis=1) / np.sqrt(n_seen)
    return np.maximum(snr.max(axis=1), together) < LIGHT_SIGMAS
