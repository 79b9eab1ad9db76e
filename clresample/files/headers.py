"""Checks the headers of a FITS file before astropy reads them.

astropy (up to 8.0 at least) loops up to numbers in a header without checks. With NAXIS =
99999999999 or SIP polynomials of order 30000 it does not end; TFIELDS = 2000000000 takes all
memory. After data of a negative size it reads the same header for ever. It does the same in
compressed files without SIMPLE or with SIMPLE = F.
"""

from __future__ import annotations

import itertools
import math
import re
import zipfile
from contextlib import contextmanager

from astropy.utils.data import get_readable_fileobj

from .atomic import FileError

BLOCK, CARD = 2880, 80  # bytes
# Largest number of cards of a header, 8 MB, so that a search for its end cannot read a whole file.
MAX_CARDS = 100_000
# Least and most of what each card may hold. 999 axes and columns are the FITS standard's limits, 9
# that of the names of SIP's coefficients; sizes and places in files are 64-bit integers.
MAX_BYTES = 2**63 - 1
LIMITS = {
    r"Z?NAXIS|TFIELDS": (0, 999),
    r"BITPIX": (-64, 64),
    r"Z?NAXIS\d+|ZTILE\d+|[PG]COUNT": (0, MAX_BYTES),
    r"WCSAXES[A-Z]?": (-math.inf, 999),
    r"[AB]P?_ORDER": (-math.inf, 9),
}
NUMBER = re.compile(
    rf"\s*(?:HIERARCH\s+)?({'|'.join(LIMITS)})\s*=\s*([^/]*)".encode(), re.IGNORECASE
)
FLAG = re.compile(rb"(GROUPS|ZIMAGE)\s*=\s*T")
SIZED = re.compile(rb"(BITPIX|NAXIS)\s*=")
OTHER = re.compile(rb"SIMPLE\s*=\s*F")
END = re.compile(rb"END([^A-Z0-9_-]|$)")


def check_headers(path):
    """Raises FileError if a header of a FITS file has an impossible number.

    All HDUs are checked, also in compressed files. Files that are not FITS or are truncated pass,
    since astropy reports them.
    """
    try:
        with _opened(path) as file:
            begins = file.read(6)
            if begins == b"SIMPLE":
                _check(path, file)
            elif _is_header(begins + file.read(MAX_CARDS * CARD)):
                raise FileError(f"{path}: damaged, begins with a header without SIMPLE")
    except FileError:
        raise
    except Exception:  # decompression fails on truncated or foreign files
        return


def _check(path, file):
    """Walks from header to header to the file's end. Raises FileError."""
    place = 0
    for number in itertools.count():
        file.seek(place)
        what = f"{path}: damaged, HDU {number}"
        cards = _cards(what, file)
        if cards is None:
            return
        if OTHER.match(cards[0]):
            raise FileError(f"{what} says that it is not FITS, SIMPLE = F")
        place += -(-len(cards) * CARD // BLOCK) * BLOCK
        place += -(-_n_bytes(what, *_values(what, cards)) // BLOCK) * BLOCK


@contextmanager
def _opened(path):
    """The file's bytes, decompressed; of a ZIP file those of its first member, as in astropy."""
    with open(path, "rb") as file:
        is_archive = file.read(4) == b"PK\x03\x04"
    if is_archive:
        with zipfile.ZipFile(path) as archive, archive.open(archive.namelist()[0]) as file:
            yield file
    else:
        with get_readable_fileobj(path, encoding="binary") as file:
            yield file


def _cards(what, file):
    """The cards of the header that begins here, or None where the file ends before it does."""
    cards = []
    while len(cards) < MAX_CARDS:
        block = file.read(BLOCK)
        for i in range(0, len(block), CARD):
            cards.append(block[i : i + CARD])
            if END.match(cards[-1]):
                return cards
        if len(block) < BLOCK:
            return None
    raise FileError(f"{what} has a header of more than {MAX_CARDS} cards")


def _is_header(text):
    """Returns True if a text is a FITS header, of whatever kind."""
    cards = [text[i : i + CARD] for i in range(0, len(text), CARD)]
    return any(map(SIZED.match, cards)) and any(map(END.match, cards))


def _values(what, cards):
    """A header's numbers {keyword: value} and its flags. Raises FileError for absurd numbers."""
    values, flags = {}, set()
    for card in cards:
        flag = FLAG.match(card)
        if flag:
            flags.add(flag[1].decode())
        found = NUMBER.match(card)
        if found is None:
            continue
        key, text = found[1].decode().upper(), found[2].decode("latin1").strip()
        claim = f"{what} has {key} = {text[:40]}"
        try:
            least, most = next(limits for name, limits in LIMITS.items() if re.fullmatch(name, key))
            # real numbers are accepted, and rounded, only for cards of the WCS
            value = int(text) if least > -math.inf else float(text.upper().replace("D", "E"))
        except ValueError:
            raise FileError(f"{claim}, not a whole number") from None
        if not least <= value <= most:
            raise FileError(f"{claim}, not in {least} to {most}")
        if values.setdefault(key, value) != value:
            raise FileError(f"{claim} and {values[key]}")
    return values, flags


def _n_bytes(what, values, flags):
    """Size of an HDU's data, less than MAX_BYTES. Raises FileError."""
    shape = _axes(what, values, "NAXIS")
    if "ZIMAGE" in flags:
        _check_tiles(what, values)
    if not shape:
        return 0
    if "GROUPS" in flags and shape[0] == 0:  # random groups have an axis of length 0
        shape = shape[1:]
    n_pixels = values.get("GCOUNT", 1) * (values.get("PCOUNT", 0) + math.prod(shape))
    n_bytes = abs(values.get("BITPIX", 8)) * n_pixels // 8
    if n_bytes > MAX_BYTES:
        raise FileError(f"{what} has {n_bytes:.1e} bytes of data by its header")
    return n_bytes


def _axes(what, values, key):
    """The lengths of the axes that the card `key` counts. Raises FileError for one left out."""
    names = [f"{key}{i + 1}" for i in range(values.get(key, 0))]
    missing = [name for name in names if name not in values]
    if missing:
        raise FileError(f"{what} has no {missing[0]}")
    return [values[name] for name in names]


def _check_tiles(what, values):
    """Raises FileError if an image has more tiles than its table has rows."""
    shape = _axes(what, values, "ZNAXIS")
    # whole rows where the header does not say it
    tiles = [values.get(f"ZTILE{i + 1}") or (1 if i else n) for i, n in enumerate(shape)]
    n_tiles = math.prod(-(-n // max(1, tile)) for n, tile in zip(shape, tiles, strict=True))
    n_rows = values.get("NAXIS2", 0)
    if n_tiles > n_rows:
        raise FileError(f"{what} holds {n_rows} tiles of an image of {n_tiles}")
