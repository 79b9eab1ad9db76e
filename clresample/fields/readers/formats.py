"""The formats by the names that FIELD.toml has for them."""

from __future__ import annotations

from ...sky.validation.checks import check_instance
from ..mosaic import Mosaic
from ..plugins import Formats
from .euclid_mer import read_euclid_mer
from .hst import read_hst
from .jwst import read_jwst
from .legacy import read_legacy_survey
from .rubin_coadd import read_rubin_coadd
from .rubin_exposure import read_rubin_exposure

OWN = {
    "euclid-mer": read_euclid_mer,
    "rubin-coadd": read_rubin_coadd,
    "rubin-exposure": read_rubin_exposure,
    "hst": read_hst,
    "jwst": read_jwst,
    "legacy": read_legacy_survey,
}
# Called as reader(path, **given), with the user's ReaderOptions; they return a Mosaic.
READERS = Formats("clresample.readers", OWN)


def read_survey(form, path, **given) -> Mosaic:
    """The Mosaic of a survey's files.

    form: of READERS; path: a file, a list of files or a folder, see its module; given: see
        ReaderOptions

    Raises ValueError for another format, what is missing, and a reader of another package that
    cannot be imported or returns something else; FileError for what cannot be read.
    """
    if form not in READERS:
        raise ValueError(f"format is {form!r}, must be {', '.join(READERS)}")
    return check_instance(
        f"the result of the reader {form!r}", READERS[form](path, **given), Mosaic
    )
