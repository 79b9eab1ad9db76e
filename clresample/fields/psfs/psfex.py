"""PSFs of PSFEx files: images times polynomials of the position, from any of their layouts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...files.atomic import FileError
from ...files.fits import open_fits
from ...sky.psf import PSF
from ...sky.varying_psf.field import PSFField, check_position

# [1] Largest scaled position. PSFEx's stars lie at -0.5 to 0.5; half of that range beyond them the
# polynomials, usually of second or third degree, still have values as inside.
MAX_SCALED = 1.0


@dataclass(frozen=True, eq=False, init=False)
class PSFExPSF(PSFField):
    """The PSF of a PSFEx file.

        P(x, y) = sum_k images_k u^i v^j,     u = (x - x0) / scale_x,  v = (y - y0) / scale_y

    with i + j <= degree, i the faster. PSFEx's samples hold the pixel response, and PSF_SAMP is
    their distance in pixels; x and y count pixels from 1.

    path: of the file, made for this mosaic's pixels: PSFEx's own, or a table with a row for each
        detector whose columns hold PSFEx's cards (legacypipe). Cards that older versions of PSFEx
        leave out (POLNAXIS, POLNGRP, PSFAXIS1 and their like) follow from the others
    detector: number of the row from 0, or its `ccdname`; None = the only one

    images (K, ny, nx) [1]; degree; zero, scale (2,) [px]: of x and y

    Raises FileError for a file that is not PSFEx's, and where `detector` does not choose a row.
    Source: Bertin 2011 (ADASS XX, 435); the manual of PSFEx, appendix on its output.
    """

    path: Path
    detector: int | str | None
    images: np.ndarray
    degree: int
    zero: np.ndarray
    scale: np.ndarray
    spacing: float
    n_bands = 1

    def __init__(self, path, detector=None):
        path = Path(path)
        for name, value in {"path": path, "detector": detector}.items():
            object.__setattr__(self, name, value)
        with open_fits(path) as hdus:
            try:
                found = _model(*_row(hdus, detector))
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                reason = error.args[0] if error.args else error
                raise FileError(f"{path}: not a PSFEx file that can be used ({reason})") from error
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @property
    def varies(self):
        return self.degree > 0

    def psf_at(self, y, x):
        """The file's PSF at (y, x), its position held within MAX_SCALED."""
        y, x = check_position(y, x)
        u, v = np.clip(self.scaled(y, x), -MAX_SCALED, MAX_SCALED)
        powers = [u**i * v**j for j in range(self.degree + 1) for i in range(self.degree + 1 - j)]
        image = np.tensordot(powers, self.images, 1).astype(np.float32)
        return PSF(image, spacing=self.spacing)

    def scaled(self, y, x) -> np.ndarray:
        """(u, v) [1] at (y, x) [px]: stars of the file lie at -0.5 to 0.5."""
        return (np.array([x, y]) + 1 - self.zero) / self.scale

    def __getstate__(self):
        return {"path": self.path, "detector": self.detector}

    def __setstate__(self, state):
        self.__init__(**state)


def _row(hdus, detector):
    """The cards {NAME: value} of a PSFEx table and its images (K, ny, nx), those of one row."""
    for hdu in hdus:
        columns = getattr(hdu, "columns", None)
        if columns is not None and "PSF_MASK" in (name.upper() for name in columns.names):
            break
    else:
        raise ValueError("no table has a column PSF_MASK")
    row = hdu.data[_number(hdu, detector)]
    cards = {name.upper(): row[name] for name in columns.names}
    images = np.asarray(cards.pop("PSF_MASK"), np.float64)
    return {key: hdu.header[key] for key in hdu.header if key} | cards, images


def _number(hdu, detector):
    """The index of a detector's row."""
    names = {column.upper(): column for column in hdu.columns.names}
    there = []
    if "CCDNAME" in names:
        there = [str(name).strip() for name in hdu.data[names["CCDNAME"]]]
    n = len(hdu.data)
    if detector is None and n == 1:
        return 0
    if isinstance(detector, str) and there.count(detector) == 1:
        return there.index(detector)
    if isinstance(detector, int) and 0 <= detector < n and n > 1:
        return detector
    if isinstance(detector, int) and n == 1 and not there:
        return 0
    known = f", ccdname {', '.join(there)}" if there else ""
    raise ValueError(
        f"psf_detector is {detector!r}, the table has {n} rows{known}: give the number of a row, "
        "from 0, or its ccdname"
    )


def _model(cards, images):
    """The fields of a PSFExPSF. Raises ValueError and KeyError for invalid ones."""
    images = images[None] if images.ndim == 2 else images
    if images.ndim != 3 or not np.isfinite(images).all():
        raise ValueError(f"PSF_MASK has the shape {images.shape}, must be (K, ny, nx), finite")
    for i, n in enumerate(images.shape[::-1]):
        if int(cards.get(f"PSFAXIS{i + 1}", n)) != n:
            raise ValueError(f"PSFAXIS{i + 1} is {cards[f'PSFAXIS{i + 1}']}, PSF_MASK has {n}")
    n_axes = int(cards.get("POLNAXIS", sum(f"POLNAME{i}" in cards for i in (1, 2, 3))))
    groups = {int(cards.get(f"POLGRP{i + 1}", 1)) for i in range(n_axes)} | {1}
    if n_axes not in (0, 2) or int(cards.get("POLNGRP", 1)) > 1 or groups != {1}:
        raise ValueError(
            f"POLNAXIS is {n_axes}, POLNGRP {cards.get('POLNGRP', 1)}: must be a polynomial of x "
            "and y in one group"
        )
    zero, scale = np.zeros(2), np.ones(2)
    for i, axis in enumerate("XY"[:n_axes]):
        name = str(cards[f"POLNAME{i + 1}"]).strip().upper()
        if not (name.startswith(axis) and name.endswith("IMAGE")):
            raise ValueError(f"POLNAME{i + 1} is {name}, must be {axis}_IMAGE or its like")
        zero[i], scale[i] = float(cards[f"POLZERO{i + 1}"]), float(cards[f"POLSCAL{i + 1}"])
    degree = int(cards["POLDEG1"]) if n_axes else 0
    if len(images) != (degree + 1) * (degree + 2) // 2 or not (np.abs(scale) > 0).all():
        raise ValueError(
            f"POLDEG1 is {degree}, POLSCAL {scale.tolist()}, PSF_MASK holds {len(images)} images: "
            f"must be {(degree + 1) * (degree + 2) // 2}, and scales other than 0"
        )
    spacing = float(cards.get("PSF_SAMP", 1.0))
    if not (0 < spacing < np.inf and np.isfinite([*zero, *scale]).all()):
        raise ValueError(f"PSF_SAMP is {spacing}, POLZERO {zero.tolist()}, must be finite, above 0")
    return {"images": images, "degree": degree, "zero": zero, "scale": scale, "spacing": spacing}
