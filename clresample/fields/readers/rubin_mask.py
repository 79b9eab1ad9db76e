"""Masks of Rubin's and HSC's images: planes with names, in one HDU or several."""

from __future__ import annotations

from ...files.atomic import FileError
from ...files.fits import open_fits
from ..field_toml.headers import bit_names, mask_value
from ..mosaic import FilePlane
from .planes import AnyFlagPlane

# Planes of pixels that a fit must ignore, because they have no measurement or a wrong one.
# Interpolated pixels (INTRP, CR) have a value consistent with the PSF; in coadds other exposures
# replace them.
UNUSABLE = "NO_DATA", "BAD", "SAT", "SATURATED", "SUSPECT", "UNMASKEDNAN"


def rubin_mask(path, grid, bits, band, notes):
    """The plane of pixels to ignore, by the HDUs MASK of a file; None where there are none.

    grid: of the image
    bits: by name or number (of a file with one HDU of masks), None = those of UNUSABLE that the
        header names
    """
    parts, planes = [], {}
    with open_fits(path) as hdus:
        for number, hdu in enumerate(hdus):
            if hdu.name == "MASK" and hdu.is_image:
                if hdu.shape != grid.shape:
                    raise FileError(f"{path}: MASK has {hdu.shape} pixels, IMAGE {grid.shape}")
                parts.append((FilePlane(path, number), bit_names(hdu.header)))
        for _, names in parts:
            planes |= names
    if not parts:
        notes.append(f"{band}: no HDU MASK in {path.name}: no pixel is masked")
        return None
    asked = [bits] if isinstance(bits, str | int) else bits
    if asked is None:
        asked = [name for name in UNUSABLE if name in planes]
    elif len(parts) > 1 and any(isinstance(bit, int) for bit in asked):
        raise ValueError(f"mask_bits has numbers, {path.name} has {len(parts)} masks: give names")
    mask_value({}, [bit for bit in asked if isinstance(bit, str)], planes)  # names that none has
    masks = []
    for plane, names in parts:
        own = [bit for bit in asked if isinstance(bit, int) or bit in names]
        masks.append((plane, mask_value({}, own, names)))
    return AnyFlagPlane(tuple(masks))
