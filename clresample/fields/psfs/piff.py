"""PSFs of Piff files, drawn by Piff."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...files.atomic import FileError
from ...sky.psf import PSF
from ...sky.varying_psf.field import PSFField, check_position

# [px] Side of the stamps that are drawn: as Rubin's; light beyond it is cut off.
STAMP_PX = 51
# What Piff calls the places of stars, in pixels and on the sky.
PLACES = "x", "y", "u", "v"


@dataclass(frozen=True, eq=False, init=False)
class PiffPSF(PSFField):
    """The PSF of a Piff file, as Piff draws it: with the pixel response, one sample a pixel.

    Needs Piff (the extra `piff`).

    path: of the file, made for this mosaic's pixels, which Piff counts from 1
    detector: the detector's number in the file, None where it holds one
    stamp_px [px]: side of the stamps, odd

    Raises FileError for a file that is not Piff's, has several detectors and none is given, or
    whose PSF depends on more than the position (a colour); ImportError without Piff; ValueError for
    an even stamp_px.
    Source: Jarvis et al. 2021 (MNRAS 501, 1282); `piff.read`, `piff.PSF.draw`.
    """

    path: Path
    detector: int | None
    stamp_px: int
    n_bands = 1

    def __init__(self, path, *, detector=None, stamp_px=STAMP_PX):
        if int(stamp_px) != stamp_px or stamp_px < 1 or stamp_px % 2 == 0:
            raise ValueError(f"stamp_px is {stamp_px}, must be an odd number of pixels")
        for name, value in (
            ("path", Path(path)),
            ("detector", detector),
            ("stamp_px", int(stamp_px)),
        ):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_model", _opened(self.path, detector))

    def psf_at(self, y, x):
        """The file's PSF at (y, x), centred on its stamp."""
        y, x = check_position(y, x)
        image = self._model.draw(
            x + 1, y + 1, chipnum=self.detector, stamp_size=self.stamp_px, center=True
        )
        return PSF(image.array)

    def __getstate__(self):
        return {"path": self.path, "detector": self.detector, "stamp_px": self.stamp_px}

    def __setstate__(self, state):
        self.__init__(**state)


def _opened(path, chip):
    """Piff's model of the file."""
    try:
        import piff
    except ImportError as error:
        raise ImportError(
            "Piff files need piff, which is not installed: pip install piff"
        ) from error
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    try:
        model = piff.read(str(path))
    except Exception as error:  # of fitsio and Piff, on what is no Piff file
        raise FileError(f"{path}: no Piff file ({' '.join(str(error).split())})") from error
    chips = sorted(int(n) for n in model.wcs)
    if (chip is None and len(chips) > 1) or (chip is not None and chip not in chips):
        raise FileError(f"{path}: chip is {chip}, the file has {', '.join(map(str, chips))}")
    others = sorted(set(model.interp_property_names) - set(PLACES))
    if others:
        raise FileError(f"{path}: its PSF depends on {', '.join(others)}, not on the place alone")
    return model
