"""The formats by the names that FIELD.toml has for them."""

from __future__ import annotations

from ..mosaic import Mosaic
from .euclid_mer import read_euclid_mer
from .hst import read_hst
from .jwst import read_jwst
from .legacy import read_legacy_survey
from .rubin_coadd import read_rubin_coadd
from .rubin_exposure import read_rubin_exposure

READERS = {
    "euclid-mer": read_euclid_mer,
    "rubin-coadd": read_rubin_coadd,
    "rubin-exposure": read_rubin_exposure,
    "hst": read_hst,
    "jwst": read_jwst,
    "legacy": read_legacy_survey,
}


def read_survey(form, path, **given) -> Mosaic:
    """The Mosaic of a survey's files.

    form: of READERS; path: a file, a list of files or a folder, see its module; given: see `Given`

    Raises ValueError for another format, and what is missing; FileError for what cannot be read.
    """
    if form not in READERS:
        raise ValueError(f"format is {form!r}, it takes {', '.join(READERS)}")
    return READERS[form](path, **given)
