"""The benchmarks of large galaxies, spoilt input and DECam's exposures: rows, truths, words."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from helpers.checkout import run_python

pytest.importorskip("galsim")

LADDER = {
    "case", "mode", "scene", "source", "role", "n", "re_px", "q", "snr", "ratio", "pull", "chi2",
    "status", "flags", "silent", "seconds", "ratios", "pulls", "total_pulls", "snrs", "position_px",
}  # fmt: skip
SPOILT = {
    "scene", "spoilt", "moved", "ratio", "own", "neighbour", "n_ratio", "n_own", "chi2", "status",
    "flags", "named", "good", "texts",
}  # fmt: skip


def run(folder, module, *options):
    """What a benchmark writes."""
    file = folder / f"{module}.json"
    result = run_python("-m", f"bench.{module}", *map(str, options), "--json", str(file))
    assert result.returncode == 0, result.stderr
    return json.loads(file.read_text())


def test_ladder(tmp_path):
    found = run(
        tmp_path, "ladder", "--only", "single,star_as_galaxy", "--modes", "one", "--scenes", 1,
        "--n", 1, "--re", 2, 3, "--snr", 100, "--processes", 1,
    )  # fmt: skip
    rows = found["rows"]
    assert all(row.keys() == LADDER for row in rows)
    assert [(row["case"], row["scene"]) for row in rows] == [
        (case, scene) for case in ("single", "star_as_galaxy") for scene in (0, 1)
    ]
    assert [row["re_px"] for row in rows] == [2, 3, None, None]
    for row in rows:
        assert not row["silent"]
        assert row["snr"] == 100
        assert row["ratio"] in row["ratios"]
        assert abs(row["pull"]) == pytest.approx(max(map(abs, row["pulls"])))
    assert found["summary"]["single, one"]["sources"] == 2
    assert found["summary"]["single, one"]["fluxes"] == 6


def test_fluxes_between_the_bounds_are_right():
    from bench.ladder import compare

    flux = np.array([0.85, 0.8, 0.9, 1.0, 1.3])
    ratio, pull = compare(flux, np.full(5, 0.1), np.full(5, 0.8), np.full(5, 1.0))
    np.testing.assert_allclose(ratio, [1, 1, 1, 1, 1.3])
    np.testing.assert_allclose(pull, [0, 0, 0, 0, 3])
    # negative light beyond the frame: the whole has less than the frame
    ratio, pull = compare(np.array([0.9]), np.array([0.1]), np.array([1.0]), np.array([0.95]))
    np.testing.assert_allclose([*ratio, *pull], [0.9 / 0.95, -0.5])
    ratio, pull = compare(np.array([0.97]), np.array([0.1]), np.array([1.0]), np.array([0.95]))
    np.testing.assert_allclose([*ratio, *pull], [1, 0])


@pytest.mark.parametrize(
    ("error", "flags", "silent"),
    [
        (0.01, 0, True),
        (0.01, 1, True),  # EDGE
        (0.01, 64, False),  # MISFIT
        (0.01, 2, False),  # NOT_CONVERGED
        (0.05, 0, False),  # 4 sigma
        (np.nan, 0, True),  # an error that is no number excuses nothing
    ],
)
def test_silently_wrong_is_over_five_percent_and_sigma_and_no_flag(
    monkeypatch, error, flags, silent
):
    from bench import ladder
    from bench.harness.ladder_scenes import Item

    monkeypatch.setattr(ladder, "catalogue", lambda _: Table({"flags": [flags]}))
    covariance = np.diag([error**2, 1.0])[None]
    monkeypatch.setattr(ladder, "fluxes", lambda _: (np.array([[1.2, 5.0]]), covariance))
    monkeypatch.setattr(ladder.scenes, "chi2_of_all", lambda _: 1.0)
    total = np.array([[1.0, 5.0]])
    scene = SimpleNamespace(items=[Item((), 100.0)], inside=0.9 * total, total=total)
    result = SimpleNamespace(status="converged")
    (row,) = ladder.rows_of("single", "one", 0, scene, result, 1.0)
    assert row["silent"] is silent
    assert row["ratio"] == pytest.approx(1.2)


def test_a_neighbour_lost_is_counted_unless_a_flag_names_it():
    from bench.ladder import is_lost

    row = {"ratios": [1.0, 2.1], "pulls": [0.0, 4.5], "flags": "EDGE"}
    assert is_lost(row)
    assert not is_lost(row | {"flags": "EDGE AMBIGUOUS"})
    assert not is_lost(row | {"pulls": [0.0, 3.9]})
    assert is_lost({"ratios": [0.4], "pulls": [-5.0], "flags": ""})


@pytest.mark.parametrize("mode", ["one", "joint"])
def test_scenes_have_the_signal_to_noise_and_the_flux_of_their_truth(mode):
    """Fluxes of two spectra and images; the light beyond the frame is in the total alone."""
    from bench.harness.ladder_cases import Limits, scene_of

    faint, bright = (scene_of("single", mode, 0, 0, Limits(4.0, 8.0, snr)) for snr in (1e3, 1e5))
    np.testing.assert_allclose(bright.total, 100 * faint.total, rtol=1e-6)
    assert (faint.inside < 0.97 * faint.total).all()  # of n = 4, 4 r_e from the centre
    assert (faint.inside > 0.7 * faint.total).all()
    power, sums = 0.0, []
    for o, less in zip(bright.observations, faint.observations, strict=True):
        light = (o.data - less.data) / 0.99  # without the noise, which is the same
        power += (light**2 * o.weights).sum()
        sums.extend(light.sum(axis=(1, 2)))
    assert np.sqrt(power) == pytest.approx(1e5, rel=1e-4)
    np.testing.assert_allclose(sums, bright.inside[0], rtol=1e-4)


def test_every_case_draws_its_sources_in_the_frame():
    from bench.harness.ladder_cases import CASES, Limits, cosmos_catalogue, scene_of

    counts = {"neighbour": 2, "pair": 2, "giant": 9}
    for case in CASES:
        if case == "cosmos" and cosmos_catalogue() is None:
            continue
        scene = scene_of(case, "one", 5, 0, Limits(largest_re_px=4.0))
        (image,) = scene.observations
        assert len(scene.sources) == counts.get(case, 1)
        assert {type(s).__name__ for s in scene.sources} == {
            "Point" if case == "galaxy_as_point" else "Extended"
        }
        for source in scene.sources:
            place = source.pixel(image.grid)
            assert (place > 10).all()
            assert (place < np.array(image.grid.shape) - 11).all()


def test_spoilt(tmp_path):
    found = run(
        tmp_path, "spoilt", "--scenes", "sim", "--only", "nothing", "listed twice",
        "a band without weight", "--clean", 1, "--processes", 1,
    )  # fmt: skip
    rows = {row["spoilt"]: row for row in found["rows"]}
    assert all(row.keys() == SPOILT for row in rows.values())
    assert list(rows) == ["nothing", "listed twice", "a band without weight"]
    assert rows["nothing"]["moved"] == 0
    assert rows["nothing"]["good"]
    assert rows["a band without weight"]["named"]
    assert abs(rows["listed twice"]["moved"]) < 3  # the two fluxes together
    assert found["clean"].keys() == {"sim", "sim 30000"}


def fitted(flux, *, error=1.0, texts=(), flags=None, listed=None):
    """A fit of three sources in one band, as `bench.spoilt.Fitted` has it."""
    from bench.spoilt import Fitted

    one = object.__new__(Fitted)
    one.flux, one.error = {"r": np.array(flux, float)}, {"r": np.full(3, error)}
    one.texts, one.status, one.chi2 = list(texts), "converged", 1.0
    one.flags = np.zeros(3, int) if flags is None else np.array(flags)
    one.listed = np.ones(3, bool) if listed is None else np.array(listed)
    return one


@pytest.mark.parametrize(
    ("flux", "texts", "named", "good"),
    [
        ((100, 50, 20), (), False, True),
        ((100, 50, 23.5), (), False, False),
        ((96, 50, 20), (), False, False),
        ((96, 50, 20), ("HSC r: sky of 0.5 sigma is left",), True, True),
        ((96, 50, 20), ("said of the unspoilt sky too",), False, False),
    ],
)
def test_a_spoilt_scene_is_good_within_three_sigma_or_with_a_word(flux, texts, named, good):
    from bench.spoilt import row_of

    reference = fitted((100, 50, 20), texts=["said of the unspoilt sky too"])
    spoilt = fitted(flux, error=2.0, texts=texts)
    row = row_of("sim", "sky + 0.5 sigma", spoilt, reference, 0)
    assert (row["named"], row["good"]) == (named, good)
    assert row["moved"] == flux[0] - 100
    assert row["own"] == (flux[0] - 100) / 2
    assert row["neighbour"] == flux[2] - 20


def test_a_source_that_is_not_listed_has_not_moved():
    from bench.spoilt import row_of

    reference = fitted((100, 50, 20))
    spoilt = fitted((0, 51, 20), listed=[False, True, True])
    row = row_of("sim", "brightest not listed", spoilt, reference, 0)
    assert np.isnan(row["moved"])
    assert row["neighbour"] == 1
    assert row["good"]
    flagged = fitted((0, 90, 20), listed=[False, True, True], flags=[0, 128, 0])
    assert row_of("sim", "core clipped", flagged, reference, 0)["named"]


def test_ways_of_spoiling_do_what_they_say():
    from bench.harness import spoiling
    from bench.harness.spoilt_scenes import simulated

    scene = simulated(3, 3)
    made = {way: change(scene, 0) for way, (change, _) in spoiling.SPOILT.items()}
    last = scene.observations[-1]
    sky = made["sky + 0.5 sigma"].observations[-1]
    sigma = last.weights[:, :1, :1] ** -0.5
    np.testing.assert_allclose(sky.data - last.data, 0.5 * sigma * np.ones(last.shape), rtol=1e-4)
    wide = made["PSF 5 % wider"].observations[-1].psf.images
    assert wide.max() / last.psf.images.max() < 0.95
    moved = made["0.3 px between bands"].observations
    assert [len(o.channels) for o in moved] == [1, 3, 3]
    place = [o.grid.pixel(*scene.places[0]) for o in moved[1:]]
    np.testing.assert_allclose(place[1] - place[0], [0.3, 0], atol=1e-6)
    assert len(made["brightest not listed"].places) == 2
    assert made["brightest not listed"].owners.tolist() == [1, 2]
    assert made["twice, 0.7 px apart"].owners.tolist() == [0, 1, 2, 0]
    grid = scene.observations[0].grid
    apart = grid.pixel(*made["positions 1 px off"].places.T) - grid.pixel(*scene.places.T)
    np.testing.assert_allclose(np.hypot(*apart.T), 1, atol=1e-6)
    ray = made["cosmic ray"].observations[0].data - scene.observations[0].data
    assert (ray != 0).sum() == 6
    small = made["units of 1e-19"].observations[0]
    np.testing.assert_allclose(
        small.data * small.weights**0.5,
        scene.observations[0].data * scene.observations[0].weights ** 0.5,
        rtol=1e-5,
    )


def test_psfex_rows_are_read_as_psfex_files(data, tmp_path):
    """A file in PSFEx's own form, kept as a row: GalSim evaluates the former."""
    from bench.harness.decam import PAIR, rows_psf
    from clresample.fields.psfs.psfex import PSFExPSF

    path = data / "decam_pair" / f"{PAIR}-psfex.fits"
    table, header = fits.getdata(path, 1, header=True)
    row = {
        key: [header[key]] for key in ("POLZERO1", "POLZERO2", "POLSCAL1", "POLSCAL2", "POLDEG1")
    }
    row["psf_mask"] = np.array(table["PSF_MASK"])
    Table(row).write(tmp_path / "rows.fits")
    for place in ((100.0, 1900.0), (3000.0, 50.0)):
        expected = PSFExPSF(path).psf_at(*place).images[0]
        found = rows_psf(tmp_path / "rows.fits", *place)
        np.testing.assert_allclose(found / found.sum(), expected, atol=1e-6)


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


@pytest.mark.parametrize(
    ("module", "options", "words"),
    [
        ("ladder", ("--only", "single,comet"), "comet"),
        ("ladder", ("--snr", "-3"), "-3 is not above 0"),
        ("spoilt", ("--only", "rain"), "rain"),
        ("spoilt", ("--scenes", "m87"), "m87"),
    ],
)
def test_bad_options_get_one_line(module, options, words):
    result = run_python("-m", f"bench.{module}", *options)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert words in result.stderr
