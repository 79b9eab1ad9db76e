"""The example's scene file: a real file, complete, and true to the simulated surveys."""

import errno
import tomllib
from importlib import resources

import numpy as np
import pytest

from clresample import PaperSettings, Settings, SingleScalePrior
from clresample.cli import example
from clresample.fields.field_toml.keys import SCENE_TABLES as TABLES, parse_scene as parse
from clresample.files.atomic import FileError
from clresample.simulation.surveys import EUCLID_VIS, RUBIN_UGRIZY

TEXT = resources.files("clresample.cli").joinpath("example.toml").read_text()


def lines():
    """All lines with a table or a key, those that are comments too, without the "# " before."""
    for line in TEXT.splitlines():
        line = line.removeprefix("# ")
        if line.startswith("[") or " = " in line.split("#")[0]:
            yield line


def test_every_key_is_shown():
    named = {line.split(" = ")[0] for line in lines()}
    for table, keys in TABLES.items():
        assert set(keys) - {"y", "x"} <= named, table  # these two stand in the comment on ra
        assert any(line.startswith((f"[{table}]", f"[[{table}]]")) for line in lines())


@pytest.mark.parametrize("left_out", ["[sources]", "[detection]"])
def test_its_optional_keys_are_correct_too(tmp_path, left_out):
    """All keys are taken as given, but for the one of two tables, weights and RMS beside variances,
    and one of the two for a cutout's place."""
    taken, table = [], ""
    for line in lines():
        table = line.split()[0] if line.startswith("[") else table
        if table != left_out and not line.startswith(("weight", "rms")):
            taken.append(line)
    (tmp_path / "scene.toml").write_text("\n".join(taken))
    found = parse(tmp_path / "scene.toml")
    assert len(found["observation"][0]) == len(TABLES["observation"]) - 4
    assert len(found["fit"]) == len(TABLES["fit"])


def test_optional_keys_of_the_fit_have_their_defaults():
    _, _, text = "\n".join(lines()).partition("[fit]")
    shown, paper = tomllib.loads(text), PaperSettings()
    assert shown.pop("monotone") is True  # which selects the paper's method
    assert shown.pop("correlation_px") == SingleScalePrior().correlation_px
    assert len(shown) > 4
    for name, value in shown.items():
        assert value == getattr(Settings() if hasattr(Settings, name) else paper, name), name


def test_noise_and_zero_points_are_those_of_the_surveys():
    observations = tomllib.loads(TEXT)["observation"]
    for table, survey in zip(observations, (EUCLID_VIS, RUBIN_UGRIZY), strict=True):
        np.testing.assert_allclose(table["variance"], survey.noise_sigma**2, rtol=1e-5)
        np.testing.assert_allclose(table["zero_point"], survey.zero_points_mag, atol=1e-4)


@pytest.mark.parametrize("older", [False, True])
def test_a_full_disk_leaves_no_half_of_it(tmp_path, monkeypatch, older):
    """The disk is full at the second PSF: no new file is there, and older ones are as they were."""
    folder, write = tmp_path / "example", example.write_hdus

    def until_full(path, hdus):
        if path.name == "rubin_psf.fits":
            path.write_bytes(b"half of it")
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, hdus)

    monkeypatch.setattr(example, "write_hdus", until_full)
    if older:
        folder.mkdir()
        (folder / "rubin.fits").write_bytes(b"older")
    with pytest.raises(FileError, match="No space left on device"):
        example.write_example(folder, overwrite=True)
    left = {path.name: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == ({"rubin.fits": b"older"} if older else {})
