"""PSFs whose width disagrees with the light of a sharper image."""

import pytest
from helpers.inspection import image_of, inspected, observed, sources_of

from clresample.sky.sources import ExtendedSource

SHARP, WIDE = 1.2, 2.4  # [px] sigma of the two images' light
PLACE = (30.3, 28.7)


def words(size, *, sharp=1.0, wide=1.0, flux=1e5, beside=(), noise=2.0, red=1.0):
    """Messages about widths, for PSFs that are wrong by factors; `red`: of the size in the second.

    size [px]: sigma of a galaxy, 0 for a star; beside: further sources, of its kind
    """
    one, other = (
        tuple((place, (flux, flux), factor * size) for place in (PLACE, *beside))
        for factor in (1.0, red)
    )
    images = [
        observed(image_of(one, sigma=SHARP, noise=noise), sigma=sharp * SHARP, name="sharp"),
        observed(
            image_of(other, seed=1, sigma=WIDE, noise=noise),
            sigma=wide * WIDE,
            name="wide",
            channels=("i", "z"),
        ),
    ]
    found = inspected(images, sources_of(one, ExtendedSource)).messages
    return [m for m in found if "than its PSF makes that of" in m]


@pytest.mark.parametrize("size", [0.0, 0.4])
@pytest.mark.parametrize(
    "wide, word", [(1.0, ""), (0.85, "too narrow"), (1.15, "too wide"), (0.5, "too narrow")]
)
def test_a_psf_of_another_width_is_named(size, wide, word):
    """For stars that were detected as galaxies, and for galaxies hardly wider than the PSF."""
    found = words(size, wide=wide)
    assert [word in m and m.startswith("wide: light is ") for m in found] == [True] * (wide != 1)


def test_the_part_is_nearly_that_of_the_psf():
    (message,) = words(0.0, wide=0.93)
    assert "in i by 7 %" in message.replace(" 6 %", " 7 %").replace(" 8 %", " 7 %")


@pytest.mark.parametrize("size, red", [(1.5, 0.9), (1.5, 1.1), (3.0, 1.0)])
def test_colours_inside_a_galaxy_are_no_width(size, red):
    assert words(size, red=red) == []


def test_a_neighbour_hides_the_width_and_faint_light_has_none():
    assert words(0.0, wide=0.85, beside=((PLACE[0] + 7, PLACE[1]),)) == []
    assert words(0.0, wide=0.85, flux=400) == []


@pytest.mark.parametrize("host", [1.5, 4.0, 8.0])
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_a_blue_point_in_a_red_host_is_no_width(host, share):
    """Of its light the sharp image has a share, the other one a fifth of that."""
    images = []
    for k, (sigma, part) in enumerate(((SHARP, share), (WIDE, share / 5))):
        drawn = ((PLACE, (1e5 * part,) * 2, 0.0), (PLACE, (1e5 * (1 - part),) * 2, host))
        name, channels = ("sharp", ("g", "r")) if k == 0 else ("wide", ("i", "z"))
        image = image_of(drawn, seed=k, sigma=sigma)
        images.append(observed(image, sigma=sigma, name=name, channels=channels))
    found = inspected(images, sources_of(((PLACE, None, None),), ExtendedSource)).messages
    assert not any("than its PSF makes that of" in m for m in found)
