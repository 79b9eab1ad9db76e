"""Wheel and sdist carry the kernels; an installed wheel renders far away from the checkout."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from helpers.checkout import ROOT

import clresample

KERNELS = sorted(path.name for path in (ROOT / "kernels").iterdir())
RENDER = """
import numpy as np
import clresample
from clresample import Grid, PSF, Resampler
print(clresample.__file__)
rubin = Grid.flat((12, 14), 0.2)
euclid = Grid.flat((24, 28), 0.1)
operator = Resampler(euclid, PSF.gaussian(1.6), rubin, PSF.gaussian(1.5))
y, x = np.indices((24, 28))
image = np.exp(-((y - 11.5) ** 2 + (x - 13.5) ** 2) / 8)
print(operator.forward(image[None]).sum() / image.sum())
"""


def run(*command, cwd):
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    answer = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return answer.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the wheel and the sdist are built, without network."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-d", folder, cwd=ROOT)
    return folder


@pytest.fixture(scope="module")
def environment(folder, tmp_path_factory):
    """A new environment with the wheel; numpy and the like are read from the running one."""
    home = tmp_path_factory.mktemp("away") / "env"
    run(sys.executable, "-m", "venv", "--without-pip", home, cwd=home.parent)
    python = home / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    options = ("--no-deps", "--no-index", "--quiet")
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, wheel, cwd=home)
    (site,) = home.glob("lib/python*/site-packages")
    # Plain folders, whose own .pth files are not read: an editable clresample stays out of sight.
    shared = dict.fromkeys(path for path in sys.path if path.endswith("-packages"))
    (site / "shared.pth").write_text("\n".join(shared))
    return home


def test_wheel_and_sdist_hold_the_kernels_and_the_example(folder):
    (wheel,) = folder.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert sorted(n.split("/")[-1] for n in names if n.startswith("clresample/kernels/")) == KERNELS
    assert any(n.endswith("licenses/LICENSE") for n in names)
    assert "clresample/cli/example.toml" in names
    assert "clresample/fields/report/page/report.css" in names
    (sdist,) = folder.glob("*.tar.gz")
    top = f"clresample-{clresample.__version__}"
    with tarfile.open(sdist) as archive:
        names = archive.getnames()
    assert {f"{top}/kernels/{name}" for name in KERNELS} <= set(names)
    assert {f"{top}/{name}" for name in ("LICENSE", "README.md", "Makefile")} <= set(names)


def test_an_installed_wheel_renders(environment):
    away = environment.parent
    where, flux = run(environment / "bin" / "python", "-I", "-c", RENDER, cwd=away).split()
    assert Path(where).is_relative_to(environment)
    assert float(flux) == pytest.approx(1, abs=1e-3)  # light that the stamp's edge cuts off


def test_an_installed_command_finds_the_devices(environment):
    table = run(environment / "bin" / "clresample", "devices", cwd=environment.parent)
    assert "largest buffer" in table


def test_the_citation_names_this_version_and_the_changelog_knows_it():
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited[1] == clresample.__version__
    assert f"\n## {clresample.__version__} " in (ROOT / "CHANGELOG.md").read_text()


def test_every_public_name_is_there():
    for name in clresample.__all__:
        assert getattr(getattr(clresample, name), "__name__", name) == name
    assert set(clresample.__all__) | {"__version__"} == set(dir(clresample))
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        clresample.missing  # noqa: B018
