"""Files with anything in them: read as what they say, or refused in one line that names them."""

import gzip
import math
import signal
import warnings
from contextlib import contextmanager

import numpy as np
from astropy.io import fits
from astropy.table import Table
from helpers.tiny_scene import gaussian, header
from hypothesis import example, given, strategies as st
from hypothesis.extra import numpy as hnp

from clresample.cli.options import printable
from clresample.fields.field_toml.keys import SCENE_TABLES as TABLES, parse_scene as parse
from clresample.files.array_hdus import array_of, image_hdu
from clresample.files.atomic import FileError
from clresample.files.fits import read_image, read_psf
from clresample.files.fits_names import check_channels, to_ascii
from clresample.files.scene_keys import SceneError
from clresample.files.source_table import read_sources

TEXT = st.text(max_size=20)
NUMBER = st.one_of(
    st.floats(), st.integers(), st.sampled_from([10**400, -(10**30), 0, 1, -0.0, 5e-324])
)
VALUE = st.recursive(
    st.one_of(NUMBER, TEXT, st.booleans()),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=8,
)


def toml(value):
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, str):
        plain = "".join(c if c.isalnum() and c.isascii() else f"\\U{ord(c):08x}" for c in value)
        return f'"{plain}"'
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return "{" + ", ".join(f"{toml(k)} = {toml(v)}" for k, v in value.items()) + "}"


def one_line(error, *names):
    """Text of an error on a terminal."""
    text = printable(" ".join(str(error).split()), 900)
    assert text.isprintable() and len(text) < 1000
    assert all(str(name) in text for name in names)


KEYS = [(table, key) for table, rules in TABLES.items() for key in rules]


@given(st.lists(st.tuples(st.sampled_from(KEYS), VALUE), max_size=6))
def test_scene_files_with_any_values(tmp_path_factory, given_values):
    tables = {
        "observation": {"name": "A", "image": "a.fits", "psf": "p.fits"},
        "sources": {"catalogue": "s.ecsv"},
    }
    for (table, key), value in given_values:
        tables.setdefault(table, {})[key] = value
    lines = []
    for name, table in tables.items():
        lines.append("[[observation]]" if name == "observation" else f"[{name}]")
        lines += [f"{key} = {toml(value)}" for key, value in table.items()]
    path = tmp_path_factory.mktemp("any") / "scene.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    try:
        found = parse(path)
    except SceneError as error:
        return one_line(error, "scene.toml")
    for name, table in tables.items():
        part = found[name][0] if name == "observation" else found[name]
        for key, value in table.items():
            rule = TABLES[name][key]
            assert rule.fits(part[key]) and (part[key] == value or value != value)


@given(st.binary(max_size=300) | st.text(max_size=300).map(lambda t: t.encode("utf-8", "replace")))
def test_scene_files_of_any_bytes(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "scene.toml"
    path.write_bytes(content)
    try:
        parse(path)
    except SceneError as error:
        one_line(error, "scene.toml")


COLUMN = hnp.arrays(
    st.sampled_from([np.float64, np.int64, "<U5", bool, np.float32]), (3,)
) | hnp.arrays(np.float64, (3, 2))


@given(
    st.dictionaries(
        st.sampled_from(["ra", "dec", "y", "x", "name", "type", "components", "observation"]),
        COLUMN,
        min_size=1,
    )
)
@example({"ra": np.arange(3.0), "dec": np.zeros(3)})
@example({"y": np.arange(3), "x": np.zeros(3), "components": np.array([1, 2, 3])})
def test_tables_with_any_columns(tmp_path_factory, columns):
    path = tmp_path_factory.mktemp("any") / "table.fits"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            Table(columns).write(path)
        except (ValueError, UnicodeEncodeError):
            return  # no such table can be written
    try:
        sources = read_sources(path)
    except ValueError as error:
        return one_line(error, "table.fits")
    assert len(sources) == 3
    for source in sources:
        position = source.sky_deg if source.position_px is None else source.position_px
        assert np.isfinite(position).all()
        n_components = getattr(source, "n_components", None)
        assert n_components is None or n_components >= 1


CARDS = st.sampled_from(
    ["CTYPE1", "CTYPE2", "CRVAL1", "CRVAL2", "CRPIX1", "CD1_1", "CD2_2", "CDELT1", "CROTA2"]
    + ["PC1_1", "CUNIT1", "EQUINOX", "RADESYS", "LONPOLE", "WCSAXES", "BAND1", "BUNIT", "A_ORDER"]
)
CARD_VALUE = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.integers(-(2**31), 2**31),
    st.booleans(),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
    st.sampled_from(["RA---TAN", "DEC--SIN", "GLON-CAR", "RA---TPV", "FREQ", "RA---TAN-SIP"]),
)


@given(st.dictionaries(CARDS, CARD_VALUE, max_size=4))
@example({"LONPOLE": 1.17e16})
def test_headers_with_any_cards(tmp_path_factory, cards):
    path = tmp_path_factory.mktemp("any") / "image.fits"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        full = header(9, 0.2)
        full.update(cards)
        fits.PrimaryHDU(np.ones((9, 9), "f4"), full).writeto(path, output_verify="ignore")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            image = read_image(path)
        except FileError as error:
            return one_line(error, "image.fits")
    assert image.data.shape == (1, 9, 9) and image.grid.shape == (9, 9)
    assert 0 < image.grid.pixel_scale_arcsec < math.inf
    n, m = np.array([4.0]), np.array([4.0])
    sky = image.grid.sky(n, m)
    if np.isfinite(sky).all():
        back = image.grid.pixel(*sky)
        assert np.abs(back - 4).max() < 1e-4 or np.isnan(back).all()


COUNTS = st.sampled_from(
    ["NAXIS", "NAXIS1", "NAXIS2", "NAXIS3", "BITPIX", "PCOUNT", "GCOUNT", "TFIELDS", "GROUPS"]
    + ["ZNAXIS", "ZNAXIS1", "ZTILE1", "ZIMAGE", "WCSAXES", "WCSAXESA", "A_ORDER", "BP_ORDER"]
    + ["THEAP", "TFORM1", "TDIM1", "BSCALE", "BLANK", "XTENSION", "EXTEND", "END", "naxis1"]
)
CLAIM = st.one_of(
    st.integers().map(str),
    st.integers(0, 400).map(str),
    st.sampled_from([10**k for k in range(3, 20)]).map(str),
    st.sampled_from(["T", "F", "1E9", "'BINTABLE'", "'1PB(9)'", "'999999999E'", "-5", "", "NaN"]),
)


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 30), COUNTS, CLAIM), min_size=1, max_size=3
    ),
    st.booleans(),
)
def test_headers_with_any_counts(tmp_path_factory, claims, zipped):
    """Cards written over any card of any HDU: the image, a compressed one, a table."""
    path = tmp_path_factory.mktemp("any") / "image.fits"
    pixels = np.round(100 * gaussian(9, 1.0)).astype(np.int32)
    hdus = [
        fits.PrimaryHDU(pixels, header(9, 0.2)),
        fits.CompImageHDU(pixels, compression_type="RICE_1"),
        fits.BinTableHDU(Table({"y": [4.0], "x": [4.0]})),
    ]
    fits.HDUList(hdus).writeto(path)
    with fits.open(path, disable_image_compression=True) as opened:
        places = [hdu.fileinfo()["hdrLoc"] for hdu in opened]
    raw = bytearray(path.read_bytes())
    for hdu, number, key, value in claims:
        there = raw.find(f"{key.upper():8}=".encode(), places[hdu])
        at = there if there >= 0 and number % 2 else places[hdu] + 80 * number
        raw[at : at + 80] = f"{key:8}= {value:>20}"[:80].ljust(80).encode()
    path.write_bytes(gzip.compress(raw) if zipped else raw)
    for read in (read_image, read_psf, read_sources):
        with warnings.catch_warnings(), at_most_seconds(5):
            warnings.simplefilter("ignore")
            try:
                read(path)
            except ValueError as error:
                one_line(error, "image.fits")


class TooSlow(BaseException):
    """No Exception: readers take those for a damaged file."""


@contextmanager
def at_most_seconds(most):
    """Fails what takes more processor time than that, as soon as Python runs again."""

    def stop(*_):
        raise TooSlow

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, most)
    try:
        yield
    except TooSlow:
        raise AssertionError(f"takes over {most} s of processor time") from None
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@given(st.integers(0, 5000), st.binary(min_size=1, max_size=40), st.booleans())
def test_damaged_files(tmp_path_factory, at, junk, cut):
    path = tmp_path_factory.mktemp("any") / "psf.fits"
    fits.PrimaryHDU(gaussian(9, 1.0)).writeto(path)
    raw = bytearray(path.read_bytes())
    raw[at : at + len(junk)] = junk
    path.write_bytes(raw[:at] if cut else raw)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            psf = read_psf(path)
        except FileError as error:
            return one_line(error, "psf.fits")
    assert np.isfinite(psf.images).all()


@given(
    hnp.arrays(
        st.sampled_from([np.float32, np.float64, np.int16]),
        hnp.array_shapes(min_side=0, max_dims=3),
    )
)
def test_arrays_come_back_to_the_bit(array):
    if array.dtype.kind == "f":  # -0.0 and the sign of infinity aside
        array = np.where(np.isneginf(array), np.inf, array).astype(array.dtype)
        most = np.finfo(array.dtype).max
        array[np.abs(array) == most] = 0
    hdu = image_hdu("X", array)
    if array.dtype.kind == "f" and array.size:
        assert np.isfinite(hdu.data).all()
    back = array_of(hdu)
    assert back.dtype == array.dtype
    np.testing.assert_array_equal(back, array)


@given(st.text(), st.integers(20, 200))
def test_any_text_on_a_terminal_and_in_a_card(text, most):
    shown = printable(text, most)
    assert shown.isprintable() and len(shown) <= most + 5
    plain = to_ascii(text)
    assert len(plain) == len(text) and all(" " <= c <= "~" for c in plain)
    fits.Card("X", plain[:60])


@given(st.lists(st.text(min_size=1, max_size=62), min_size=1, max_size=4, unique=True))
def test_channels_that_pass_are_columns(names):
    try:
        check_channels(names)
    except ValueError as error:
        return one_line(error)
    table = Table({f"flux_err_{to_ascii(name)}": [1.0] for name in names})
    assert len(fits.table_to_hdu(table).columns) == len(names)
