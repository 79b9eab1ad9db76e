"""Parts on disk: what went in comes out, of sources that failed too."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from helpers.fields import mosaics_of

from clresample.deblending.solver.scene import ComponentStructure
from clresample.fields.blends.plan import FitRegion
from clresample.fields.execution.group_results import (
    COMPONENT_COLUMNS,
    PATCH_COLUMNS,
    GroupResults,
    GroupResultsFile,
)
from clresample.fields.run import reference_grid
from clresample.files.atomic import FileError
from clresample.measurement.columns import Columns
from clresample.sky.box import Box

PATCH = FitRegion(number=7, parent=3 << 41, box=Box(5, 6, 25, 36), sources=(0,))


@pytest.fixture
def part():
    ok, failed = Columns(meta={"frame": "icrs"}), Columns()
    ok.put("ra", [1.5, -2.0], u.deg)
    ok.put("flux", [np.inf, 3e-9], u.uJy)
    ok.put("flags", np.array([64, 0], np.int32))
    ok.put("n_components", np.array([1, 2]))
    failed.put("ra", [7.0], u.deg)
    failed.put("flags", np.array([2], np.int32))
    for rows, status, reason in ((ok, "converged", ""), (failed, "failed", "no pixel")):
        rows.put("id", np.arange(len(rows), dtype=np.int64) + (5 << 41))
        rows.put("status", np.full(len(rows), status))
        rows.put("reason", np.full(len(rows), reason))
    made = GroupResults(rows=[ok, Columns(), failed])
    made.patches = [
        (7, 3 << 41, 0, "converged", 2, 600, 20, 0.25, "a | b"),
        (9, 1, 1, "failed: x", 1, 9, 0, 0.0, ""),
    ]
    return made


def read(part, tmp_path):
    path = tmp_path / "fit-0-000000.arrays"
    path.write_bytes(part.to_bytes())
    return GroupResultsFile(path), path


def test_sources_that_failed_leave_whole_numbers_whole(part, tmp_path):
    named = "flux_it's a long name" + " of a channel" * 2
    part.rows[0].put(named, np.array([1.0, 2.0]))
    file, _ = read(part, tmp_path)
    (rows,) = file.read("CATALOGUE")
    np.testing.assert_array_equal(rows[named], [1.0, 2.0, np.nan])
    assert len(rows) == 3 and rows.meta == {"FRAME": "icrs", "EXTNAME": "CATALOGUE"}
    assert rows.units == {"ra": u.deg, "flux": u.uJy}
    assert rows["ra"].tolist() == [1.5, -2.0, 7.0]
    np.testing.assert_array_equal(rows["flux"], [np.inf, 3e-9, np.nan])
    assert rows["n_components"].tolist() == [1, 2, 0] and rows["flags"].tolist() == [64, 0, 2]
    assert [rows[name].dtype.str for name in ("flags", "id", "flux")] == ["<i4", "<i8", "<f8"]
    assert rows["id"].tolist() == [5 << 41, (5 << 41) + 1, 5 << 41]
    assert rows["status"].tolist() == ["converged", "converged", "failed"]
    assert rows["reason"].tolist() == ["", "", "no pixel"]


def test_patches_components_and_models_come_back(part, tmp_path):
    morphology = np.arange(6.0).reshape(2, 3)
    part.add_component(11, PATCH, np.array([8, 9]), morphology, np.array([1.0, np.nan]), [0.5])
    part.add_component(12, PATCH, np.array([1, 2]), 2 * morphology, np.array([3.0, 4.0]), [])
    models = {0: np.full((1, 4, 5), 2.5), 1: np.arange(12.0).reshape(2, 2, 3)}
    boxes = {0: Box(0, 1, 4, 6), 1: Box(7, 8, 9, 11)}
    for i, model in models.items():
        part.add_model(PATCH, i, boxes[i], model)
    file, _ = read(part, tmp_path)
    patches, components = file.read("PATCHES", "COMPONENTS")
    assert list(patches.values) == list(PATCH_COLUMNS)
    assert patches["fit_id"].tolist() == [7, 9] and patches["parent_id"].tolist() == [3 << 41, 1]
    assert patches["status"].tolist() == ["converged", "failed: x"]
    assert patches["seconds"].tolist() == [0.25, 0.0]
    rows = np.stack([components[name] for name in COMPONENT_COLUMNS], axis=1).tolist()
    assert rows == [[11, 3 << 41, 7, 8, 9, 2, 3, 0], [12, 3 << 41, 7, 1, 2, 2, 3, 6]]
    spectra, morphologies = file.read("SPECTRA", "MORPHOLOGIES")
    np.testing.assert_array_equal(spectra, [[1.0, np.nan], [3.0, 4.0]])
    assert morphologies.tolist() == [*range(6), *range(0, 12, 2)]
    found = list(file.models())
    assert [(patch, i, box) for patch, i, box, _ in found] == [(7, i, boxes[i]) for i in (0, 1)]
    for _, i, _, model in found:
        np.testing.assert_array_equal(model, models[i])
    assert list(file.models({8})) == []
    assert [m[1] for m in file.models(mosaic=1)] == [m[1] for m in found if m[1] == 1]


def test_profiles_come_back_digit_by_digit_of_the_patches_asked_for(part, tmp_path):
    one, star = (0.1, 0.2, -1 / 3, np.log(6.5)), (0.5, -0.5)
    rows = (11, PATCH, one), (11, PATCH, one[::-1]), (12, PATCH, star), (13, PATCH, ())
    for number, patch, theta in (*rows, (14, replace(PATCH, number=8), one)):
        part.add_component(number, patch, np.zeros(2), np.ones((2, 3)), np.ones(2), theta)
    file, _ = read(part, tmp_path)
    found = file.last_fits({7: (0, 0), 8: (0, 0), 9: (0, 0)})
    profiles = {patch: own for patch, (own, _) in found.items()}
    of_7 = {11: (one, one[::-1]), 12: (star,), 13: ((),)}
    assert profiles == {7: of_7, 8: {14: (one,)}, 9: {}} and file.last_fits({}) == {}


def test_structure_comes_back_of_the_patch_asked_for(part, tmp_path):
    """In the pixels of its frame; components without structure keep their places."""
    rng = np.random.default_rng(0)
    one, two = (
        ComponentStructure(
            (k, 2 * k), (rng.random((2, k)), rng.random((k, 1))), rng.random(2), k > 1
        )
        for k in (1, 2)
    )
    rows = (
        (11, PATCH, one),
        (12, PATCH, None),
        (11, PATCH, two),
        (13, replace(PATCH, number=8), one),
    )
    for number, patch, own in rows:
        origin = np.array([30, 40]) + (own or one).origin
        part.add_component(number, patch, origin, np.ones((2, 3)), np.ones(2), (), own)
    file, _ = read(part, tmp_path)
    ((_, found),) = file.last_fits({7: (30, 40)}).values()
    assert list(found) == [11, 12] and found[12] == (None,)
    for back, own in zip(found[11], (one, two), strict=True):
        assert back.origin == own.origin and back.clear is own.clear
        np.testing.assert_array_equal(back.strengths, own.strengths)
        for z, wanted in zip(back.coefficients, own.coefficients, strict=True):
            np.testing.assert_array_equal(z, wanted.astype(np.float32))


def test_an_empty_part_is_a_file_too(tmp_path):
    file, _ = read(GroupResults(), tmp_path)
    assert [len(one) for one in file.read("CATALOGUE", "PATCHES", "PIXELS")] == [0, 0, 0]
    assert list(file.models()) == [] and file.last_fits({7: (0, 0)}) == {7: ({}, {})}


def test_the_same_results_are_the_same_bytes_and_damaged_ones_are_refused_in_a_line(part, tmp_path):
    part.add_model(PATCH, 0, Box(0, 1, 4, 6), np.ones((1, 4, 5)))
    content = part.to_bytes()
    assert content == part.to_bytes()
    file, path = read(part, tmp_path)
    line = content.index(b"\n") + 1
    for bad in (
        b"",
        content[:100],
        content[:line],
        content[:-1],
        content + b"0",
        b"[]\n",
        b"\xff\n",
    ):
        path.write_bytes(bad)
        for reading in (lambda: file.read("FOUND"), lambda: list(file.models())):
            with pytest.raises(FileError, match=r"fit-0-000000.arrays: cannot be read, or .*\)$"):
                reading()
    path.unlink()
    with pytest.raises(FileError, match=r"arrays: cannot be read, or is damaged \(No such file"):
        file.read("FOUND")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("caf\u00e9", "'caf\u00e9' must be printable ASCII"),
        ("g ", "'g ' must be printable ASCII without a space at its end"),
        ("g" * 64, "FITS takes 68: give observations and channels shorter names"),
        ("g'" * 30, "has [0-9]+ characters, FITS takes 68"),
    ],
)
def test_names_that_no_part_can_hold_are_refused_before_the_fits(sky, name, message):
    euclid, _ = mosaics_of(sky)
    renamed = replace(euclid, channels=(replace(euclid.channels[0], name=name),))
    for mosaic in (replace(euclid, name=name), renamed):
        with pytest.raises(ValueError, match=message):
            reference_grid([mosaic])


def test_mosaics_whose_files_would_be_one_are_refused(sky):
    euclid, rubin = mosaics_of(sky)
    with pytest.raises(ValueError, match="file names of mosaics must be unique, not u_g, u_g"):
        reference_grid([replace(euclid, name="u g"), replace(rubin, name="u_g")])
