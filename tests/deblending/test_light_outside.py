"""Light outside of what was observed: analytic profiles, whose part outside is known."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.blends import SCALE, blend, gaussian, observe, one_source

from clresample.deblending.assessment.edge import continued, light_outside, reaches_outside
from clresample.deblending.posterior.errors import Errors
from clresample.deblending.posterior.shared_light import flux_changes
from clresample.deblending.profiles import GalaxyProfile
from clresample.deblending.result import Component, noted
from clresample.measurement.catalogue import Flag, catalogue
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF


def exponential(shape, centre, scale):
    y, x = np.indices(shape)
    return np.exp(-np.hypot(y - centre[0], x - centre[1]) / scale)


def beyond(shape):
    """A frame that was all observed, with its border."""
    return np.pad(np.zeros(shape, bool), 1, constant_values=True)


@pytest.mark.parametrize("scale", [4.0, 8.0, 12.0])
def test_an_exponential_goes_on_as_one(scale):
    image = exponential((61, 61), (30, 30), scale)
    wanted = 2 * np.pi * scale**2 - image.sum()
    found = continued((0, 0), image, (30, 30), beyond((61, 61)))
    assert found == pytest.approx(wanted, rel=0.2, abs=0.3)


def test_half_a_galaxy_has_as_much_outside():
    whole = gaussian((61, 61), (30, 30), 36 * np.eye(2))
    image = whole[27:]  # cut 3 px beside its middle
    found = continued((0, 0), image, (3, 30), beyond(image.shape))
    assert found == pytest.approx(whole[:27].sum(), rel=0.1)
    outside = beyond((61, 61))
    outside[:28] = True  # or not observed there
    assert continued((27, 0), image, (30, 30), outside) == pytest.approx(found, rel=1e-6)


def test_light_that_ends_within_the_frame_has_none_outside():
    image = gaussian((31, 31), (15, 15), 4 * np.eye(2))
    assert continued((20, 20), image, (35, 35), beyond((71, 71))) < 1e-6
    assert continued((0, 0), np.zeros((5, 5)), (2, 2), beyond((5, 5))) == 0


def galaxy(sigma_px, *, wings=6.0, frame=(61, 61)):
    """A result of one galaxy in the middle of its frame, whose box is all of it, and its shape."""
    grid = Grid.flat(frame, SCALE)
    shape, at = GalaxyProfile(Frame(grid, PSF.gaussian(0.8))), (np.array(frame) - 1) / 2
    theta = np.array([np.log(sigma_px), 0, 0, np.log(wings)])
    (image,) = shape.draw_box(theta, at, (0, 0), frame, slopes=False)
    part = Component(0, (0, 0), image / image.max(), np.array([50.0, 100.0]))
    seen = observe(grid, ("g", "r"), weights=1e-12)
    covariance = np.full((2, 1, 1), 1e-4)
    result = blend([part], observations=(seen,), grid=grid, covariance=covariance)
    return result, ([shape], [theta], [at], np.ones(1)), max(1 - image.sum(), 0)


def errors_of(result, sigma):
    """Errors of one source, of all fluxes sigma."""
    variance = np.full((2, 1, 1), sigma**2)
    colour = sigma**2 * np.eye(2)[None]
    moments, maps = np.full((1, 5, 5), np.nan), (np.zeros((61, 61)),)
    zero = np.zeros((1, 2)), np.zeros((1, 5)), np.ones((1, 2))
    return Errors(variance, colour, moments, maps, np.zeros((1, 6)), *zero)


def with_light(errors, outside):
    """These with light outside, as a fit's."""
    changes = flux_changes(np.zeros((1, 2, 0)), np.zeros((1, 1, 2)), outside[None])
    return replace(changes.added_to(errors), outside=outside)


def test_a_galaxys_profile_says_how_much_is_outside():
    """If it is the smaller estimate; it is not much less than the true light of such a galaxy."""
    for sigma_px in (4.0, 8.0, 14.0):
        result, given, rest = galaxy(sigma_px)
        part = light_outside(result, *given)[0] / result.components[0].flux
        assert part[0] == pytest.approx(part[1])
        assert 0.7 * rest <= part[0] * (1 - rest) <= 1.001 * rest + 1e-9
    result, given, rest = galaxy(8.0, wings=0.3)  # wings that the continued morphology lacks
    assert 0 < light_outside(result, *given)[0, 0] <= result.components[0].flux[0]


def test_edge_and_errors_have_the_light_outside():
    for sigma_px, wanted in ((4.0, False), (14.0, True)):
        result, given, _ = galaxy(sigma_px)
        outside = light_outside(result, *given)
        before = errors_of(result, 30.0)
        errors = with_light(before, outside)
        np.testing.assert_allclose(errors.flux[:, 0, 0], 30.0**2 + outside[0] ** 2)
        np.testing.assert_allclose(errors.colour[0, 0, 1], outside[0, 0] * outside[0, 1])
        found = replace(result, errors=errors)
        flux = np.array([c.flux for c in result.components])
        assert reaches_outside(found, flux).tolist() == [wanted]
        table = catalogue(found)
        assert bool(table["flags"][0] & Flag.EDGE) == wanted
        assert table["flux_err_g"][0].value == pytest.approx(np.hypot(30.0, outside[0, 0]))
    assert not catalogue(replace(result, errors=before))["misfit_fraction"][0]


def test_noise_at_the_edge_is_no_light_there():
    """A flux whose noise is larger than what is outside."""
    result, given, _ = galaxy(14.0)
    errors = with_light(errors_of(result, 1.0), light_outside(result, *given))
    noisy = replace(result, errors=errors, covariance=np.full((2, 1, 1), 1e4))
    assert not reaches_outside(noisy, np.array([c.flux for c in result.components])).any()


def test_copies_of_a_result_keep_what_was_derived_from_its_model():
    """Positions of its pixels, unobserved pixels, and its misfit; nothing is derived for them.
    Pickles derive the first two anew."""
    result = one_source()
    footprints, outside = result.footprints, result.unobserved
    copy = noted(result, status="misfit")
    assert copy.status == "misfit" and copy.footprints is footprints
    assert copy.unobserved is outside and "misfit" not in vars(copy)
    back = pickle.loads(pickle.dumps(copy))
    assert not {"footprints", "unobserved"} & set(vars(back))
    np.testing.assert_array_equal(back.unobserved, outside)
