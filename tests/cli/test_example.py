"""The example's scene file: a real file, complete, and true to the simulated surveys."""

import tomllib
from importlib import resources

import numpy as np
import pytest

from clresample.files.scene_keys import TABLES, parse
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
    """All keys are taken as given, but for the one of two tables, and weights beside variances."""
    taken, table = [], ""
    for line in lines():
        table = line.split()[0] if line.startswith("[") else table
        if table != left_out and not line.startswith("weight"):
            taken.append(line)
    (tmp_path / "scene.toml").write_text("\n".join(taken))
    found = parse(tmp_path / "scene.toml")
    assert len(found["observation"][0]) == len(TABLES["observation"]) - 2
    assert len(found["fit"]) == len(TABLES["fit"])


def test_noise_and_zero_points_are_those_of_the_surveys():
    observations = tomllib.loads(TEXT)["observation"]
    for table, survey in zip(observations, (EUCLID_VIS, RUBIN_UGRIZY), strict=True):
        np.testing.assert_allclose(table["variance"], survey.noise_sigma**2, rtol=1e-5)
        np.testing.assert_allclose(table["zero_point"], survey.zero_points_mag, atol=1e-4)
