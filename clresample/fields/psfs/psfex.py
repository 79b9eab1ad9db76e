"""PSFs of PSFEx files, evaluated by GalSim."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...files.whole_file import FileError
from ...sky.psf import PSF
from ...sky.varying.field import PSFField, finite


@dataclass(frozen=True, eq=False, init=False)
class PSFExPSF(PSFField):
    """The PSF of a PSFEx file (`.psf`): images times polynomials of the position.

    Needs GalSim (the extra `sim`). PSFEx's samples hold the pixel response, and PSF_SAMP of the
    file is their distance in pixels.

    path: of the file, made for this mosaic's pixels

    Raises FileError for a file that is not PSFEx's, ImportError without GalSim.
    Source: Bertin 2011 (ADASS XX, 435); `galsim.des.DES_PSFEx`.
    """

    path: Path
    n_bands = 1

    def __init__(self, path):
        object.__setattr__(self, "path", Path(path))
        object.__setattr__(self, "_model", _opened(self.path))

    def psf_at(self, y, x):
        """The file's PSF at (y, x); PSFEx counts pixels from 1."""
        import galsim

        y, x = finite(y, x)
        image = self._model.getPSFArray(galsim.PositionD(x + 1, y + 1))
        return PSF(image, spacing=float(self._model.sample_scale))

    def __getstate__(self):
        return {"path": self.path}

    def __setstate__(self, state):
        self.__init__(state["path"])


def _opened(path):
    """GalSim's model of the file."""
    try:
        from galsim.des import DES_PSFEx
    except ImportError as error:
        raise ImportError(
            "PSFEx files need GalSim, which is not installed: pip install 'clresample[sim]'"
        ) from error
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    try:
        return DES_PSFEx(str(path))
    except Exception as error:  # of astropy and GalSim, on what is no PSFEx table
        raise FileError(f"{path}: no PSFEx file ({' '.join(str(error).split())})") from error
