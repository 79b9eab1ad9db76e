"""Whole runs over a small field: what they leave, interrupted, in tiles, cut, with bad files."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from helpers.fields import mosaics_of

from clresample import FieldOptions, Flag, get_device
from clresample.fields import options, run
from clresample.fields.blends import plan
from clresample.fields.blends.cut import FitLimits
from clresample.fields.execution import fitting, search_setup
from clresample.fields.models import read_models
from clresample.fields.mosaic import FilePlane
from clresample.fields.options import RunProgress
from clresample.fields.run import run_field
from clresample.files.atomic import HOST, FileError
from clresample.sky.box import Box


def table(folder, name="catalogue"):
    return QTable.read(folder / f"{name}.ecsv")


def compared(folder, other):
    """Differences of fluxes [errors] of the sources that two runs share, and how many they do not;
    of those detected before the fit. Those beyond Euclid's edge are counted, but not compared:
    fluxes at Rubin's own edge, from parts of the light, depend on rounding."""
    a, b = table(folder), table(other)
    a, b = a[a["detection_pass"] == 1], b[b["detection_pass"] == 1]
    shared, i, j = np.intersect1d(a["id"], b["id"], return_indices=True)
    differences = [
        ((a[f"flux_{c}"][i] - b[f"flux_{c}"][j]) / a[f"flux_err_{c}"][i]).value
        for c in ("VIS", "i")
    ]
    differences = np.array(differences)
    inside = np.isfinite(differences).all(axis=0)
    assert (~inside).sum() < inside.sum()
    return differences[:, inside], len(a) + len(b) - 2 * len(shared)


def test_every_source_has_an_id_a_parent_a_status_and_the_truth_within_its_errors(done, sky):
    folder, run = done
    rows, blends = table(folder), table(folder, "fit_table")
    assert run.outputs.n_sources == len(rows) > 5
    assert len(set(rows["id"])) == len(rows) and (np.diff(rows["id"]) > 0).all()
    assert set(rows["parent_id"]) <= set(rows["id"])
    assert set(rows["status"]) == {"converged"}
    assert blends["n_sources"].sum() == len(rows)
    assert (blends["seconds"] > 0).all() and blends["seconds"].unit == "s"
    y, x = sky.truth["y"], sky.truth["x"]
    apart = np.hypot(rows["y"].value[:, None] - y, rows["x"].value[:, None] - x)
    assert np.median(apart.min(axis=1)) < 1
    alone = (rows["n_blend_sources"] == 1) & (apart.min(axis=1) < 1.5)
    near = np.sort(apart, axis=1)[:, 1] > 15
    assert (alone & near).sum() >= 2
    which = apart.argmin(axis=1)
    for channel in ("VIS", "i"):
        error = rows[f"flux_err_{channel}"].value
        pulls = (rows[f"flux_{channel}"].value - sky.truth[f"flux_{channel}"][which]) / error
        assert np.median(abs(pulls[alone & near])) < 2


def test_the_three_catalogues_are_one_with_units_and_descriptions(done):
    folder, _ = done
    text, binary = table(folder), QTable.read(folder / "catalogue.fits")
    assert text.colnames == binary.colnames
    assert binary["flux_i"].unit == text["flux_i"].unit == "uJy"
    assert "total flux in i" in text["flux_i"].info.description
    np.testing.assert_array_equal(text["flux_i"], binary["flux_i"])
    flux, error = (text[f"{key}_i"].value for key in ("flux", "flux_err"))
    good = flux > 0
    assert good.any()
    np.testing.assert_allclose(text["mag_i"].value[good], 23.9 - 2.5 * np.log10(flux[good]))
    of_mag = np.where(good, 2.5 / np.log(10) * error / flux, np.nan)
    np.testing.assert_allclose(text["mag_err_i"].value, of_mag)
    colour = (text["mag_VIS"] - text["mag_i"]).value
    np.testing.assert_allclose(text["colour_VIS_i"].value, colour, atol=1e-12)
    known = np.isfinite(colour)
    most = np.hypot(text["mag_err_VIS"].value, text["mag_err_i"].value)
    assert (text["colour_err_VIS_i"].value[known] < most[known]).all()
    assert "magnitude" in text["mag_i"].info.description
    pq = pytest.importorskip("pyarrow.parquet")
    columns = pq.read_table(folder / "catalogue.parquet")
    assert columns.column_names == text.colnames
    np.testing.assert_array_equal(columns["flux_i"], text["flux_i"].value)
    about = columns.schema.field("flux_i").metadata
    assert about[b"unit"] == b"uJy" and about[b"description"] == b"total flux in i"


def test_one_blend_is_read_alone_and_models_add_up_to_the_mosaics(done, sky):
    folder, _ = done
    rows = table(folder)
    parent = int(rows["parent_id"][0])
    few = read_models(folder / "models.fits", parent)
    members = rows["id"][rows["parent_id"] == parent]
    assert {m.id for m in few} == set(members.tolist())
    everything = read_models(folder / "models.fits")
    assert len(everything) == len(rows)
    for model in few:
        same = next(m for m in everything if m.id == model.id)
        np.testing.assert_array_equal(model.morphology, same.morphology)
        assert abs(model.morphology.max() - 1) < 1e-5 and model.spectrum.shape == (2,)
    with pytest.raises(FileError, match="no blend has the parent_id 1"):
        read_models(folder / "models.fits", 1)
    for mosaic in sky.mosaics:
        name = mosaic.survey.name
        model, header = fits.getdata(folder / f"model_{name}.fits", header=True)
        residual = fits.getdata(folder / f"residual_{name}.fits")
        np.testing.assert_allclose(model + residual, mosaic.data, rtol=1e-5, atol=1e-3)
        assert header["BAND1"] == mosaic.survey.bands[0] and "CRVAL1" in header
        # sources beyond the edge of Euclid, whose pixels are the model's, are not in the model
        n, m = np.indices(mosaic.grid.shape)
        at = mosaic.grid.positions_in(sky.mosaics[0].grid, n, m)
        inner = ~mosaic.bad_pixels & ((at > 12) & (at < 180)).all(axis=-1)
        left = residual[:, inner] / mosaic.noise_sigma[:, None]
        assert 0.97 < 1.4826 * np.median(abs(left)) < 1.05
        assert np.percentile(abs(left), 99.9) < 5


class _Stop(RunProgress):
    """Stops a run as Ctrl-C does, after so many groups of fits."""

    def __init__(self, n):
        self.name, self.left, self.predicted_s = "", n, None

    def stage(self, name, total):
        self.name = name

    def time_left(self, seconds):
        self.predicted_s = seconds

    def step(self, n, sources=0):
        if self.name == "fit" and n:
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt


def test_an_interrupted_run_goes_on_to_the_same_bytes(done, sky, tmp_path):
    folder, _ = done
    mosaics = mosaics_of(sky)
    stop = _Stop(1)
    with pytest.raises(KeyboardInterrupt):
        run_field(mosaics, tmp_path, progress=stop)
    assert stop.predicted_s is not None and 0 <= stop.predicted_s < 3600
    parts = sorted((tmp_path / "work").glob("fit-*.arrays"))
    assert len(parts) == 1 and not (tmp_path / "catalogue.fits").exists()
    before = parts[0].stat().st_mtime_ns
    with pytest.raises(FileError, match="--resume goes on"):
        run_field(mosaics, tmp_path)
    other = FieldOptions(threshold=6.0)
    with pytest.raises(FileError, match=r"another threshold, 5.0 and not 6.0"):
        run_field(mosaics, tmp_path, options=other, resume=True)
    n_most = 1 << 22  # numbers of processes lie below
    left = tmp_path / "work" / f".part-{HOST}-{n_most}-0a" / "fit-x.arrays"  # killed as it wrote
    left.parent.mkdir()
    left.write_bytes(parts[0].read_bytes()[:100])
    run_field(mosaics, tmp_path, resume=True)
    assert not left.parent.exists()
    assert parts[0].stat().st_mtime_ns == before  # what was done is not done again
    for name in ("catalogue.fits", "catalogue.ecsv", "models.fits", "residual_Euclid.fits"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


def test_tiles_leave_no_seams(done, sky, tmp_path):
    """Sources and their fits are in one order, however the field was searched: fits side by side
    round alike."""
    folder, _ = done
    options = FieldOptions(tile_px=64, overlap_px=60)
    run_field(mosaics_of(sky), tmp_path, options=options)
    assert len(list((tmp_path / "work").glob("tile-*.npz"))) == 25
    differences, n_others = compared(folder, tmp_path)
    assert n_others == 0
    assert np.abs(differences).max() == 0


@pytest.fixture(scope="module")
def cut(done, sky, tmp_path_factory):
    """The folder of a run whose largest blends are cut; and of each blend that was fitted whether
    it was a later round's, and the numbers of components and profiles that it was given."""
    largest = int(table(done[0])["n_blend_sources"].max())
    options, folder = FieldOptions(limits=FitLimits(max_sources=largest - 1)), tmp_path_factory
    folder, given, carried = folder.mktemp("cut"), [], []
    with_profiles = fitting.with_profiles

    def noted(blend, profiles, structures, *, single):
        blend = with_profiles(blend, profiles, structures, single=single)
        counts = [s.n_components for s in blend.sources]
        given.append((bool(profiles), counts, [len(own) for own in blend.thetas]))
        for source, own in zip(blend.sources, blend.structures, strict=bool(blend.structures)):
            for one in (one for one in own if one is not None):
                carried.append(one)
                size = np.array(one.coefficients[0].shape)  # in the frame of this piece
                assert (np.abs(np.array(source.position_px) - one.origin - size / 2) < size).all()
        return blend

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "with_profiles", noted)
        run_field(mosaics_of(sky), folder, options=options)
    assert len(carried) > 1
    return folder, given


def test_a_blend_over_the_limits_is_cut_and_each_source_measured(done, cut):
    rows = table(cut[0])
    largest = int(table(done[0])["n_blend_sources"].max())
    assert largest >= 3
    assert set(rows["status"]) == {"converged"}
    where = rows["n_blend_sources"] == largest
    reasons = {str(reason) for reason in rows["reason"][where]}
    assert all("pieces" in reason for reason in reasons) and reasons
    rounds = table(cut[0], "fit_table")["n_refits"]
    assert rounds.min() == 0 and rounds.max() >= 1
    differences, n_others = compared(done[0], cut[0])
    assert n_others == 0 and np.median(np.abs(differences)) < 0.5


def test_later_rounds_keep_the_components_and_go_on_from_their_profiles(cut):
    """Those of the fit before; the first leaves them to the data, as does that of new sources."""
    first, later = ([own for own in cut[1] if own[0] == k] for k in (False, True))
    assert first and all(set(ns) == {None} and not any(known) for _, ns, known in first)
    assert later and all(ns == [n or None for n in known] for _, ns, known in later)
    new = table(cut[0])["detection_pass"] == 2
    assert sum(known.count(0) for _, _, known in later) == new.sum()


def test_rounds_that_are_resumed_end_with_the_same_bytes(cut, done, sky, tmp_path):
    """They go on from the profiles in the files of the round before."""
    folder = shutil.copytree(cut[0], tmp_path / "again")
    later = sorted((folder / "work").glob("fit-[1-9]*.arrays"))
    assert later
    for path in later:
        path.unlink()
    largest = int(table(done[0])["n_blend_sources"].max())
    options = FieldOptions(limits=FitLimits(max_sources=largest - 1))
    run_field(mosaics_of(sky), folder, options=options, resume=True)
    for name in ("catalogue.fits", "models.fits", "residual_Euclid.fits"):
        assert (folder / name).read_bytes() == (cut[0] / name).read_bytes(), name


def test_pixels_that_cannot_be_read_cost_their_blends_alone_with_a_reason(sky, tmp_path):
    path = tmp_path / "euclid.fits"
    euclid, rubin = mosaics_of(sky)
    fits.PrimaryHDU(sky.mosaics[0].data[0]).writeto(path)
    channel = replace(euclid.channels[0], data=FilePlane(path, 0))
    mosaics = replace(euclid, channels=(channel,)), rubin
    with pytest.raises(KeyboardInterrupt):
        run_field(mosaics, tmp_path / "out", progress=_Stop(1))
    n = sky.mosaics[0].data.shape[1]
    path.write_bytes(path.read_bytes()[: 2880 + 4 * n * (n // 2)])
    from clresample.fields.strips import _opened

    _opened.cache_clear()
    run = run_field(mosaics, tmp_path / "out", resume=True)
    rows = table(tmp_path / "out")
    failed = np.array([status == "failed" for status in rows["status"]])
    assert run.failed and failed.any() and not failed.all()
    assert all("euclid.fits" in str(reason) for reason in rows["reason"][failed])
    assert np.isfinite(rows["ra"]).all() and np.isnan(rows["flux_i"][failed]).all()


def test_known_sources_are_taken_where_they_are(done, sky, tmp_path):
    folder, _ = done
    rows = table(folder)
    shuffled = np.random.default_rng(0).permutation(len(rows))
    listed = SkyCoord(rows["ra"], rows["dec"])[[*shuffled, 0]]  # the last one is there twice
    names = [*(f"no {i}" for i in shuffled), "again"]
    options = FieldOptions(positions=listed, names=names, passes=1)
    run_field(mosaics_of(sky), tmp_path, options=options)
    known = table(tmp_path)
    again = np.array(known["name"] == "again")
    np.testing.assert_array_equal(known["id"][~again], rows["id"])
    assert known["name"][~again].tolist() == [f"no {i}" for i in range(len(rows))]
    assert known.colnames[:2] == ["id", "name"] and np.isin(known["id"][again] - 1, rows["id"])
    assert set(known["detection_pass"]) == {1}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"passes": 3}, "passes is 3"),
        ({"field_number": -1}, "field_number is -1"),
        ({"group_memory": 1000}, "group_memory is 1000 bytes"),
        ({"names": ["a"]}, "names has 1 names, must have one for each of 0 positions"),
        ({"workers": -1}, "workers is -1"),
        ({"area": "VIS"}, "area is 'VIS', must be 'auto', 'all', 'finest'"),
    ],
)
def test_options_out_of_range_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        FieldOptions(**given)


def test_mosaics_that_do_not_go_together_are_refused(sky, tmp_path):
    euclid, rubin = mosaics_of(sky)
    with pytest.raises(ValueError, match="mosaics is empty"):
        run_field([], tmp_path)
    with pytest.raises(ValueError, match="names of mosaics must be unique"):
        run_field([euclid, euclid], tmp_path)
    bare = replace(rubin, channels=tuple(replace(c, zero_point=None) for c in rubin.channels))
    with pytest.raises(ValueError, match="'Euclid' has zero points, 'Rubin' has none"):
        run_field([euclid, bare], tmp_path)


def test_parts_of_a_field_together_are_the_field(done, sky, tmp_path):
    folder, _ = done
    whole, ids = table(folder), []
    for i in (1, 2):
        options = FieldOptions(part=(i, 2), margin_px=110)
        out = tmp_path / f"part{i}"
        run_field(mosaics_of(sky), out, options=options)
        rows = table(out)
        ids += rows["id"].tolist()
        _, a, b = np.intersect1d(rows["id"], whole["id"], return_indices=True)
        change = (rows["flux_VIS"][a] - whole["flux_VIS"][b]) / whole["flux_err_VIS"][b]
        assert np.nanmax(np.abs(change)) < 0.1
        assert {m.id for m in read_models(out / "models.fits")} == set(rows["id"].tolist())
        part, header = fits.getdata(out / "model_Euclid.fits", header=True)
        n = sky.mosaics[0].data.shape[1]
        assert 0 <= part.shape[2] - n // 2 <= 2 and "CRVAL1" in header
        if i == 1:
            half = np.s_[..., : n // 2]
            model = fits.getdata(folder / "model_Euclid.fits")[half]
            np.testing.assert_allclose(part[half], model, atol=1e-2 * model.max())
    assert sorted(ids) == whole["id"].tolist()


def test_sources_beyond_the_edge_of_the_finest_mosaic_are_in_the_catalogue(done, sky, tmp_path):
    folder, run = done
    rows, grid = table(folder), sky.mosaics[0].grid
    beyond = ~Box.of(grid.shape).contains(np.stack([rows["y"].value, rows["x"].value], axis=1))
    assert beyond.any() and not any("not searched" in note for note in run.outputs.notes)
    assert np.isnan(rows["flux_VIS"][beyond]).all() and np.isfinite(rows["flux_i"][beyond]).all()
    assert (rows["flags"][beyond] & int(Flag.NO_COVERAGE)).all()
    run = run_field(mosaics_of(sky), tmp_path, options=FieldOptions(area="finest", passes=1))
    (note,) = (note for note in run.outputs.notes if "not searched" in note)
    assert "% of Rubin" in note
    assert set(table(tmp_path)["id"]) <= set(rows["id"][~beyond])


def test_several_devices_have_a_process_each_and_leave_the_same_bytes(done, sky, tmp_path):
    folder, _ = done
    name = get_device().name  # named twice, it gets two processes
    run = run_field(mosaics_of(sky), tmp_path, options=FieldOptions(device=[name, name]))
    assert {outcome.worker for stage, outcome in run.task_times if stage == "fit"} == {0, 1}
    assert (tmp_path / "catalogue.fits").read_bytes() == (folder / "catalogue.fits").read_bytes()
    with pytest.raises(ValueError, match="device is an empty list"):
        FieldOptions(device=[])


@pytest.mark.parametrize("free", [1 << 30, 5 << 30, 100 << 30])
def test_blends_are_cut_alike_whatever_memory_is_free(free, monkeypatch):
    monkeypatch.setattr(options, "free_memory", lambda: free)
    for workers in (0, 2, 16):
        given = FieldOptions(workers=workers).with_memory()
        assert given.limits == FitLimits()
        assert options.MIN_MEMORY <= given.group_memory <= free / (8 * max(workers, 1)) + (1 << 26)
    asked = FieldOptions(worker_memory=2 << 30).with_memory()
    assert asked.limits.max_bytes == asked.group_memory == 3 << 28
    asked = FieldOptions(group_memory=1 << 28, worker_memory=4 << 30).with_memory()
    assert asked.limits.max_bytes == asked.group_memory == 1 << 28


def test_groups_shrink_with_the_device_and_leave_the_same_sources(sky, tmp_path, monkeypatch):
    monkeypatch.setattr(plan, "STEP_PX", 32)  # so that this small field has groups of several
    folder, tmp_path = tmp_path / "all", tmp_path / "few"
    once = FieldOptions(passes=1, area="finest", margin_px=0)  # no blend over the small memory
    run_field(mosaics_of(sky), folder, options=once)
    device, small = get_device(), 8 << 20
    monkeypatch.setattr(search_setup, "DEVICE_PART", device.memory // small)
    for module in (run, options):
        monkeypatch.setattr(module, "MIN_MEMORY", 1 << 20)
    run_field(mosaics_of(sky), tmp_path, options=once)
    n_groups, n_small = (len(list((f / "work").glob("fit-*"))) for f in (folder, tmp_path))
    assert n_small > n_groups
    differences, n_others = compared(folder, tmp_path)
    assert n_others == 0 and np.abs(differences).max() < 0.1  # errors: other groups round otherwise
