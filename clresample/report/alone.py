"""Models of single sources on the instruments' pixels, for pictures without their neighbours."""

from __future__ import annotations

import numpy as np

from ..device.errors import DeviceError
from ..fields.cutouts import FieldCutouts, MissingSource
from ..files.atomic import FileError
from ..sky.box import Box

MAX_SOURCES = 1000  # of a page: each takes some 20 core-milliseconds an instrument


class OwnModels:
    """Renders single sources of a finished run, MAX_SOURCES at most.

    Needs the inputs of the run, models.fits and an OpenCL device. Without them `on` returns None,
    and a note gives the reason.
    """

    def __init__(self, run, notes):
        self._cutouts, self._notes = None, notes
        self._rendered: set[int] = set()
        whole = run.finished and not run.settings.get("part")
        if not whole or not (run.folder / "models.fits").is_file():
            return
        try:
            self._cutouts = FieldCutouts(run.folder)
        except (FileError, DeviceError, ImportError, ValueError) as error:
            self._give_up(error)

    def _give_up(self, reason):
        self._cutouts = None
        self._notes.append(f"no pictures of sources without their neighbours: {reason}")

    def on(self, source, instrument, box):
        """Model (C, ny, nx) [counts] of a source on a Box of an instrument's pixels.

        None for a source without a model, or if it cannot be rendered.
        """
        if self._cutouts is None:
            return None
        if source not in self._rendered and len(self._rendered) == MAX_SOURCES:
            return None
        self._rendered.add(source)
        names = [mosaic.name for mosaic in self._cutouts.mosaics]
        try:
            found, _, first = self._cutouts.separate([source], names.index(instrument.name))
        except MissingSource:
            return None
        except (FileError, DeviceError, ValueError) as error:
            self._give_up(error)
            return None
        own = Box(*first, *(np.add(first, found.own.shape[1:]).tolist()))
        image = np.zeros((len(instrument.channels), *box.shape))
        both = own.intersection(box)
        if both.area:
            image[:, *both.relative_to(box).slices] = found.own[:, *both.relative_to(own).slices]
        return image
