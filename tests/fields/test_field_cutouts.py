"""Single sources of a finished field without their neighbours, rebuilt from what the run keeps."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from helpers.fields import mosaics_of

from clresample import FieldCutouts, FieldOptions, Settings, read_cutouts, run_field
from clresample.cli import main
from clresample.deblending.cutouts.separation import KINDS
from clresample.fields import cutouts as module
from clresample.fields.execution.group_results import GroupResults, GroupResultsFile
from clresample.fields.models import ModelFile
from clresample.files.atomic import FileError
from clresample.sky.box import Box


@pytest.fixture(scope="module")
def field(done, sky):
    return FieldCutouts(done[0], mosaics_of(sky))


def place(cut):
    """Slices of the mosaic that a cutout shows."""
    y, x = -int(cut.meta["LTV2"]), -int(cut.meta["LTV1"])
    return slice(y, y + cut.shape[-2]), slice(x, x + cut.shape[-1])


@pytest.mark.parametrize("name", ["Euclid", "Rubin"])
def test_source_and_neighbours_are_the_model_of_the_run(field, done, name):
    """Rebuilt light against the mosaics of models that the fits themselves rendered."""
    whole = fits.getdata(done[0] / f"model_{name}.fits")[0]
    left = fits.getdata(done[0] / f"residual_{name}.fits")[0]
    for one in field.ids[:6].tolist():
        cut = {what: field.cutout(one, name, what) for what in KINDS}
        here = place(cut["data"])
        models = cut["model"].data + cut["neighbours"].data
        sigma = np.nanmedian(cut["residual"].uncertainty.array)
        away = np.abs(models - whole[here]) / sigma
        assert np.median(away) < 0.02 and away.max() < 1  # beyond fits' boxes the run has no light
        np.testing.assert_allclose(cut["data"].data, cut["model"].data + cut["residual"].data)
        known = np.isfinite(cut["residual"].data) & (away < 0.01)
        expected = left[here][known]
        np.testing.assert_allclose(cut["residual"].data[known], expected, atol=0.02 * sigma)
        added = cut["data"].uncertainty.array - cut["residual"].uncertainty.array
        assert np.nanmin(added) >= 0


def test_a_sky_that_the_run_subtracted_is_not_in_cutouts(field, done, sky, tmp_path):
    folder, channel = tmp_path / "out", field.mosaics[1].channels[0].name
    shutil.copytree(done[0], folder)
    about = json.loads((folder / "provenance.json").read_text())
    assert about["sky_levels"] == {}
    (folder / "provenance.json").write_text(json.dumps(about | {"sky_levels": {channel: 7.0}}))
    lower = FieldCutouts(folder, mosaics_of(sky)).cutout(int(field.ids[1]), channel)
    data = field.cutout(int(field.ids[1]), channel).data
    np.testing.assert_allclose(lower.data, data - 7.0, atol=1e-4)


def test_names_sizes_groups_and_units(field):
    one = int(field.ids[1])
    channel = field.mosaics[1].channels[0].name
    by = [field.cutout(one, name, size=15, unit="uJy") for name in (1, "Rubin", channel)]
    for cut in by:
        assert cut.shape == (15, 15) and str(cut.unit) == "uJy" and cut.psf.ndim == 2
        np.testing.assert_array_equal(cut.data, by[0].data)
    lon, lat = by[0].wcs.all_pix2world(7, 7, 0)
    row = Table.read(field.folder / "catalogue.fits")
    row = row[row["id"] == one][0]
    scale = field.mosaics[1].grid.pixel_scale_arcsec / 3600
    assert np.hypot((lon - row["ra"]) * np.cos(np.radians(lat)), lat - row["dec"]) < scale
    group = field.cutout(one, 0, "model", size=31, group=True)
    members = field.ids[field.group_ids == field.group_ids[1]].tolist()
    several = field.cutout(members, 0, "model", size=31)
    np.testing.assert_array_equal(group.data, several.data)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((1, 0), "source is 1, must be an id of"),
        (([], 0), "source is empty"),
        (("id", "VISTA"), "observation is 'VISTA', must be a number from 0 to 1"),
        (("id", 0, "light"), "what is 'light'"),
    ],
)
def test_names_that_are_none_are_refused(field, given, message):
    source, *rest = given
    with pytest.raises(ValueError, match=message):
        field.cutout(int(field.ids[0]) if source == "id" else source, *rest)


def test_other_mosaics_and_other_folders_are_refused(field, done, sky, tmp_path):
    with pytest.raises(FileError, match="is a run over the channels"):
        FieldCutouts(done[0], mosaics_of(sky)[:1])
    with pytest.raises(FileError, match="holds no finished run"):
        FieldCutouts(tmp_path)
    with pytest.raises(FileError, match="no such folder"):
        FieldCutouts(tmp_path / "none")
    with pytest.raises(FileError, match="names no field file: give the mosaics"):
        FieldCutouts(done[0])


@pytest.fixture(scope="module")
def moved(sky, tmp_path_factory):
    """A run whose second mosaic lies half a pixel off, with shifts and skies fitted."""
    folder = tmp_path_factory.mktemp("moved")
    settings = Settings(max_iter=60, fit_shifts=True, fit_sky=True)
    options = FieldOptions(settings=settings, passes=1, threshold=12)
    run_field(mosaics_of(sky), folder, options=options)
    return folder


def test_shifts_and_skies_of_the_fits_are_kept_and_followed(moved, sky):
    models = ModelFile(moved / "models.fits")
    assert any(any(models.shift(i, 1)) for i in range(len(models.spectra)))
    assert not any(any(models.shift(i, 0)) for i in range(len(models.spectra)))
    assert any(models.sky(i).any() for i in range(len(models.spectra)))
    field = FieldCutouts(moved, mosaics_of(sky))
    whole = fits.getdata(moved / "model_Rubin.fits")[0]
    inner = (
        Box.of(sky.mosaics[0].grid.shape)
        .grown(-30)
        .contains(np.stack([field._columns["y"], field._columns["x"]], axis=1))
    )
    light = [models.spectra[models.table["id"] == i].sum() for i in field.ids]
    brightest = int(field.ids[np.argmax(np.where(inner, light, 0))])
    cut = [field.cutout(brightest, "Rubin", what, size=9) for what in ("model", "neighbours")]
    expected = whole[place(cut[0])]
    np.testing.assert_allclose(cut[0].data + cut[1].data, expected, atol=0.003 * expected.max())


def test_a_fitted_shift_moves_what_is_rebuilt(done, sky):
    """By two pixels, for a mosaic whose pixels are the models'."""
    field = FieldCutouts(done[0], mosaics_of(sky))
    one = int(field.ids[np.argmax(field._models.spectra[:, 0] > 0)])
    still = field.cutout(one, "Euclid", "model", size=25).data
    row = np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    field._models._offsets.update(dict.fromkeys(field._models.table["fit_id"].tolist(), row))
    moved = field.cutout(one, "Euclid", "model", size=25).data
    a, b = moved[:, 3:-5], still[:, 5:-3]
    known = np.isfinite(a) & np.isfinite(b)
    assert known.sum() > 200
    np.testing.assert_allclose(a[known], b[known], atol=2e-3 * np.nanmax(still))


def test_offsets_are_read_back_also_where_there_are_none(tmp_path):
    part, patch = GroupResults(), SimpleNamespace(number=3)
    part.add_offsets(patch, [[0, 0], [0.25, -0.5]], [0.0, 1.5])
    part.add_offsets(SimpleNamespace(number=4), np.zeros((2, 2)), np.zeros(2))
    for one, rows in ((part, [[3, 0, 0, 0.25, -0.5, 0, 1.5]]), (GroupResults(), [])):
        (tmp_path / "a.arrays").write_bytes(one.to_bytes())
        assert GroupResultsFile(tmp_path / "a.arrays").read("OFFSETS")[0].tolist() == rows


@pytest.fixture
def copied(done, sky, tmp_path, monkeypatch):
    """A folder whose provenance names a field file, which stands for the mosaics in memory."""
    folder = tmp_path / "out"
    shutil.copytree(done[0], folder)
    about = json.loads((folder / "provenance.json").read_text())
    inputs = tmp_path / "field.toml"
    inputs.write_text("")
    about["inputs"] = {"field": {"file": str(inputs)}}
    about["run"]["inputs"] = {str(inputs): [7, 7]}
    (folder / "provenance.json").write_text(json.dumps(about))
    found = SimpleNamespace(mosaics=mosaics_of(sky), inputs={"field": inputs})
    monkeypatch.setattr(module, "read_field", lambda path: found)
    return folder


def test_the_command_writes_many_sources_into_one_file(copied, field, tmp_path, capsys):
    ids = field.ids[:3].tolist()
    Table({"id": ids[1:]}).write(tmp_path / "some.ecsv")
    out = tmp_path / "cut.fits"
    arguments = ["cutout", str(copied), "--id", str(ids[0]), "-o", str(out)]
    assert main([*arguments, "--ids-from", str(tmp_path / "some.ecsv")]) == 0
    told = capsys.readouterr()
    assert "field.toml has changed since the run" in told.err
    assert f"6 cutouts of 3 sources: {out}" in told.out
    found = read_cutouts(out)
    assert [c.meta["OBJECT"] for c in found] == [str(i) for i in ids for _ in range(2)]
    expected = field.cutout(ids[1], "Rubin")
    np.testing.assert_allclose(found[3].data, expected.data, rtol=1e-6)
    assert main([*arguments, "--quiet"]) == 2
    assert "exists already" in capsys.readouterr().err
    more = ["--overwrite", "--quiet", "--group", "--what", "model", "--observation", "Euclid"]
    assert main([*arguments, *more, "--size", "2arcsec", "--unit", "uJy"]) == 0
    (one,) = read_cutouts(out)
    assert one.meta["CUTKIND"] == "model" and str(one.unit) == "uJy" and one.shape == (20, 20)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ([], "--id is missing"),
        (["--id", "x"], "--id is x: ids of a field are numbers"),
        (["--id", "7"], "source is 7, must be an id of"),
        (["--ids-from", "none.ecsv"], "no such file"),
        (["--id", "7", "--size", "2.5"], "'2.5' is not a size"),
        (["--id", "7", "--what", "light"], "invalid choice"),
    ],
)
def test_mistakes_are_told_in_one_line(copied, tmp_path, capsys, more, message):
    arguments = ["cutout", str(copied), "-o", str(tmp_path / "cut.fits"), "--quiet", *more]
    try:
        assert main(arguments) == 2
    except SystemExit as ended:
        assert ended.code == 2
    told = capsys.readouterr()
    assert message in told.err and told.err.count("\n") == 1 and told.out == ""
    assert not (tmp_path / "cut.fits").exists()
