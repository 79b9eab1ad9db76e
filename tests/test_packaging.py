"""Wheel and sdist carry the kernels; an installed wheel renders far away from the checkout."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
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
    """Builds the wheel and the sdist in a folder, without network."""
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
    assert "clresample/report/page/report.css" in names
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


CONDA_NAMES = {"astropy": "astropy-base", "matplotlib": "matplotlib-base"}


def listed(requirements):
    """{conda's name: lower bound} of requirements as pip or conda write them."""
    parts = [re.fullmatch(r"([\w-]+)(?:\[\w+\])? ?(?:>=(.+))?", text) for text in requirements]
    return {CONDA_NAMES.get(part[1], part[1]): part[2] for part in parts}


def test_conda_installs_what_pip_does():
    """The recipe's and the environment's packages and bounds are those of pyproject.toml."""
    yaml = pytest.importorskip("yaml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = listed(project["dependencies"])
    recipe = yaml.safe_load((ROOT / "tools/conda/meta.yaml").read_text())
    assert recipe["package"]["version"] == clresample.__version__
    run_packages = listed(recipe["requirements"]["run"])
    assert needed.items() <= run_packages.items()
    assert {"pocl", "ocl-icd-system"} <= set(run_packages)
    made = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    extras = project["optional-dependencies"]
    needed |= listed([*extras["sim"], *extras["plot"], *extras["field"]])
    assert needed.items() <= listed([entry for entry in made if isinstance(entry, str)]).items()
    (script,) = recipe["build"]["entry_points"]
    assert script == " = ".join(*project["scripts"].items())


def test_all_is_every_extra_but_the_large_ones_and_the_developers():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (whole,) = extras.pop("all")
    left_out = {"jax", "torch", "scarlet2", "peers", "docs", "dev"}
    named = set(re.search(r"\[(.+)\]", whole)[1].split(","))
    packages = {package for name in named for package in extras[name]}
    assert packages >= {p for name in set(extras) - left_out for p in extras[name]}
    assert not named & left_out
