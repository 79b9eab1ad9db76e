"""Properties of an image by its header: zero point, saturation level, names of mask bits."""

from __future__ import annotations

import math

NANOJANSKY, MICROJANSKY, NANOMAGGY = 31.4, 23.9, 22.5  # [mag] AB of one, to a millimagnitude
JANSKY = 8.90  # [mag] AB of one: -2.5 log10(3631)
# cards that hold an AB zero point: Euclid's MER, DES, SWarp's users, HSC
ZERO_POINTS = "MAGZERO", "MAGZPT", "MAGZP", "PHOTZP", "ZEROPNT", "MAG_ZERO"
BIT_PREFIX = "MP_"  # of Rubin's and HSC's masks: MP_SAT = 1 means that bit 1 is SAT
LAST_BIT = 62  # of masks, which are read as integers of 64 bits with a sign
STERADIAN_ARCSEC2 = (180 / math.pi * 3600) ** 2
AREAS = "beam", "arcsec", "sr"  # in a BUNIT: of a surface brightness, whose sum is no flux
TOTALS = "electrons", "electron", "e-", "counts", "count", "dn", "adu"  # BUNITs of a whole exposure


def zero_point(header, pixel_scale_arcsec) -> float | None:
    """AB magnitude of one count [mag] from a header, or None.

    By BUNIT: nJy, uJy, Jy, nanomaggies, and MJy/sr with the pixels' area; by FLUXMAG0, the counts
    of magnitude 0; by PHOTFLAM and PHOTPLAM of HST, of one count a second, and by EXPTIME for a
    BUNIT of TOTALS; by a card of ZERO_POINTS, taken as AB.

    Raises ValueError for a BUNIT of any other surface brightness, such as Jy/beam.
    """
    text = str(header.get("BUNIT", "")).strip().replace(" ", "")
    unit = text.lower()
    named = {
        "njy": NANOJANSKY,
        "ujy": MICROJANSKY,
        "microjy": MICROJANSKY,
        "jy": JANSKY,
        "nanomaggy": NANOMAGGY,
        "nanomaggies": NANOMAGGY,
        "nmgy": NANOMAGGY,
    }
    if unit in named:
        return named[unit]
    if unit == "mjy/sr" and text[0] == "M":
        area = header.get("PIXAR_SR") or pixel_scale_arcsec**2 / STERADIAN_ARCSEC2
        return JANSKY - 2.5 * math.log10(1e6 * float(area))
    if any(area in unit for area in AREAS):
        raise ValueError(
            f"BUNIT is {text}, must be a flux per pixel: multiply the pixels and their errors by "
            "the area of a pixel (of values per beam: over that of the beam), and change BUNIT"
        )
    if _positive(header, "FLUXMAG0"):
        return 2.5 * math.log10(float(header["FLUXMAG0"]))
    cards = ["PHOTFLAM", "PHOTPLAM", *(["EXPTIME"] if unit in TOTALS else [])]
    if all(_positive(header, card) for card in cards):
        # Bohlin et al. 2011 (AJ 141, 173)
        flam, plam, *seconds = (float(header[card]) for card in cards)
        return -2.5 * math.log10(flam / math.prod(seconds)) - 5 * math.log10(plam) - 2.408
    for card in ZERO_POINTS:
        if isinstance(header.get(card), int | float):
            return float(header[card])
    return None


def saturation(header) -> float | None:
    """Level [the image's unit] from which on pixels are saturated, by SATURATE; None without."""
    return float(header["SATURATE"]) if _positive(header, "SATURATE") else None


def bit_names(header) -> dict[str, int]:
    """The bits of a mask by name, as its header has them.

    MP_SAT = 1 means that bit 1 is SAT (Rubin, HSC); so does MSKN0001 = 'SAT' with MSKM0001 = 2, its
    power of two (lsst.images).
    """
    names = {}
    for key in header:
        if key[:3] == BIT_PREFIX:
            names[key.removeprefix(BIT_PREFIX)] = int(header[key])
        elif key[:4] == "MSKN" and f"MSKM{key[4:]}" in header:
            names[str(header[key])] = int(header[f"MSKM{key[4:]}"]).bit_length() - 1
    return names


def mask_value(header, bits, known=None) -> int:
    """The sum of 2^n over the bits to ignore, given by number or by name.

    known {name: bit}: of the format, None = those of the header
    Raises ValueError for a name that neither has, and for a bit that no integer of 64 bits has.
    """
    names = bit_names(header) if known is None else known
    value = 0
    for bit in [bits] if isinstance(bits, str | int) else bits:
        if isinstance(bit, str) and bit not in names:
            there = ", ".join(names) or f"none, as it has no cards {BIT_PREFIX}* or MSKN*"
            raise ValueError(f"mask_bits has {bit!r}, the mask's header names {there}")
        number = names[bit] if isinstance(bit, str) else bit
        if number > LAST_BIT:
            raise ValueError(f"mask_bits has {bit!r}, bit {number}, must be at most {LAST_BIT}")
        value |= 1 << number
    return value


def _positive(header, card):
    value = header.get(card)
    return isinstance(value, int | float) and 0 < value < math.inf
