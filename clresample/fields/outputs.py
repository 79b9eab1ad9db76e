"""Outputs of a field: catalogues, table of fits, models by source, model and residual mosaics."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from astropy.io import fits

from .. import __version__
from ..deblending.ended import Ended
from ..files.atomic import atomic_tree, check_output
from ..files.parquet import write_parquet
from ..files.tables import table_hdu
from .columns import finalise_catalogue
from .execution.group_results import SEPARATOR, last_rounds
from .execution.search_setup import read_search_setup
from .hats import write_hats
from .model_mosaics import file_name, write_mosaics
from .models import write_models
from .sky_level import subtracted_levels

NO_PARQUET = "no catalogue.parquet: pyarrow is not installed (pip install pyarrow)"
FILES = (
    *("catalogue.parquet", "catalogue.fits", "catalogue.ecsv", "fit_table.ecsv", "models.fits"),
    "provenance.json",
)
MAX_NOTED = 8  # kinds of messages of fits that notes name
PACKAGES = (  # those whose numbers enter a catalogue, or whose formats are read and written
    *("numpy", "scipy", "astropy", "pyopencl", "pocl-binary-distribution", "sep"),
    *("pyarrow", "astropy-healpix", "galsim", "gwcs"),
)


@dataclass(frozen=True, eq=False)
class FieldOutputs:
    """Files that were written.

    paths: of the files; n_sources, n_blends; status: how many fits ended how; notes: a line each
    """

    paths: tuple[Path, ...]
    n_sources: int
    n_blends: int
    status: dict = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def check_outputs(folder, mosaics):
    """Raises FileError if an output path is a folder, link or device, which are kept."""
    names = list(FILES)
    for mosaic in mosaics:
        names += [f"{what}_{file_name(mosaic.name)}.fits" for what in ("model", "residual")]
    for name in names if folder.is_dir() else ():
        check_output(folder / name, overwrite=True)


def write_outputs(
    folder, job, parts, unsettled, about, seconds, hats=False, notes=(), names=None
) -> FieldOutputs:
    """Writes all outputs of a field together or none; the folder of HATS before them.

    folder: to write into; job: FieldJob; parts: GroupResultsFiles, those of later rounds last
    unsettled: parents of cut blends whose pieces did not settle
    about: plain values for the provenance; seconds: wall time by stage so far
    hats: write the catalogue in the HATS layout too, if it has rows; notes: of the run so far
    names {id: name}: of listed sources, None = the catalogue has no column of them

    catalogue.{parquet,fits,ecsv} are identical for repeated runs of the same field: times are in
    fit_table.ecsv and provenance.json. Raises FileError.
    """
    last = last_rounds([part.read("PATCHES")[0] for part in parts])
    table, blends = finalise_catalogue(job, parts, last, unsettled, names)
    status = Counter(Ended(str(s).partition(":")[0]) for s in blends["status"])
    notes = [*notes, *([] if find_spec("pyarrow") else [NO_PARQUET])]
    notes += [*_unmeasured(job, table, blends), *_noted_messages(job, blends)]
    paths = [write_hats(folder / "hats", table)] if hats and len(table) else []
    with atomic_tree(folder) as part:
        made = list(_write_catalogues(part, table))
        made.append(_write_ecsv(part / "fit_table.ecsv", blends))
        made.append(write_models(part / "models.fits", job, parts, last, set(table["id"].tolist())))
        made += write_mosaics(part, job, parts, last)
        made.append(_write_provenance(part / "provenance.json", job, about, seconds, status))
    paths += [folder / path.name for path in made]
    return FieldOutputs(tuple(paths), len(table), len(blends), dict(status), tuple(notes))


def _unmeasured(job, table, fits) -> list[str]:
    """A line on each mosaic that measures no source while another one does, or on no source."""
    if not len(fits) and not job.is_part and not job.plan.failed_tiles:
        return [
            f"no source was detected over {job.threshold:g} sigma, and the catalogue is empty: "
            "lower threshold in [detection], or list sources"
        ]
    empty = [m.name for m in job.mosaics if np.isnan(table[f"chi2_{m.name}"]).all()]
    return [
        f"{name}: no pixel at any source has a weight, so that its fluxes are NaN; check its "
        "image, weights or variance, and mask"
        for name in empty
        if len(empty) < len(job.mosaics)
    ]


def _noted_messages(job, fits) -> list[str]:
    """A line on each kind of messages of a table of fits, the most frequent first.

    Messages of one kind are equal up to the first colon or bracket: all begin with a sentence, and
    give their numbers after it.
    """
    names = {mosaic.name for mosaic in job.mosaics}
    kinds: Counter[str] = Counter()
    for text in fits["messages"].tolist():
        found = set()
        for line in text.split(SEPARATOR):
            label, _, rest = line.partition(": ")
            known, rest = (f"{label}: ", rest) if label in names else ("", line)
            found.add(known + re.split("[:(]", rest)[0].strip())
        kinds.update(found - {""})
    most = sorted(kinds.items(), key=lambda pair: (-pair[1], pair[0]))[:MAX_NOTED]
    return [f"{n} of {len(fits)} fits: {kind}; see fit_table.ecsv" for kind, n in most]


def _write_catalogues(folder, table):
    """The catalogue in all forms: Parquet where pyarrow is there, FITS, ECSV."""
    if find_spec("pyarrow"):
        write_parquet(folder / "catalogue.parquet", table)
        yield folder / "catalogue.parquet"
    hdus = [fits.PrimaryHDU(), table_hdu(table, "CATALOGUE")]
    fits.HDUList(hdus).writeto(folder / "catalogue.fits")
    yield folder / "catalogue.fits"
    yield _write_ecsv(folder / "catalogue.ecsv", table)


def _write_ecsv(path, table):
    table.write(path, format="ascii.ecsv")
    return path


def _write_provenance(path, job, about, seconds, status):
    """Writes the provenance: versions, device, settings, inputs with checksums, times."""
    packages = {}
    for name in PACKAGES:
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = None
    files = about.get("inputs", {})
    found = {
        "clresample": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "packages": packages,
        "device": ", ".join(read_search_setup(job.folder).devices),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "run": json.loads((job.folder / "run.json").read_text()),
        "failed_tiles": job.plan.failed_tiles,
        "sky_levels": subtracted_levels(job.mosaics),
        "fits": dict(status),
        "seconds": seconds,
        "inputs": {what: {"file": str(f), "sha256": _checksum(f)} for what, f in files.items()},
    }
    path.write_text(json.dumps(found, indent=1))
    return path


def _checksum(path):
    """SHA-256 of a file, read piece by piece; None where it is there no longer."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
