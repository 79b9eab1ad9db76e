"""One patch of sky to deblend (Blend), and its result if the fit failed (Failure)."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass

import numpy as np

from ..sky.frame import Frame, grow_to_sources, model_frame
from ..sky.observation import Observation, check_observations
from ..sky.sources import Source, check_unique_names
from ..sky.validation.checks import as_float_array, check_instance, check_sequence
from .ended import Ended
from .solver.scene import ComponentStructure

# Limits of one fit. Its spectra are solved together, in time n^3 for n components: 2000 take
# minutes. Several arrays of components times pixels are in memory at a time. Sources further apart
# than 4096 pixels need no joint fit.
MAX_COMPONENTS, MAX_BYTES, MAX_PIXELS = 2000, 8 << 30, 1 << 24
# [bytes] Memory of a fit for each pixel of a component's box, for bright galaxies, and for each
# pixel of the frame and the data: 60 sources at 512 px take 0.4 GB, 300 at 1024 px 1 GB.
BYTES_A_BOX, BOX_PIXELS, BYTES_A_PIXEL = 40, 256 * 256, 100


@dataclass(frozen=True)
class Blend:
    """One patch of sky: its observations and its sources.

    observations: at least one Observation; sources: PointSource and ExtendedSource
    frame: the model's Frame; None = `model_frame` of the observations, grown as `grow_to_sources`
        does if a source lies just outside
    shifts (n_observations, 2) [model px]: of the observations' pixels, if known; a fit of shifts
        starts from them. If a fit finds a shift of more than a pixel, start a second fit from it,
        because the profiles of the first came from images that disagreed
    thetas (S): `Result.thetas` of an earlier fit of these sources on a frame of the same pixels,
        None or () for sources that it did not have; their profiles start from them. (): for none
    structures (S): `Result.structures` of that fit, on this frame or one with the same first
        pixel; structure and strengths start from them where they describe the data better than
        the profiles alone
    """

    observations: tuple[Observation, ...]
    sources: tuple[Source, ...]
    frame: Frame | None = None
    shifts: np.ndarray | None = None
    thetas: tuple = ()
    structures: tuple = ()

    def check(self):
        """Raises ValueError for parts of another type, and for two sources of one name."""
        check_sequence("observations", self.observations, Observation)
        check_sequence("sources", self.sources, Source)
        check_unique_names(self.sources)
        if self.frame is not None:
            check_instance("frame", self.frame, Frame)
        n = len(self.sources)
        for name in ("thetas", "structures"):
            if (n_entries := len(getattr(self, name))) not in (0, n):
                raise ValueError(
                    f"{name} has {n_entries} entries, must have one for each of {n} sources or "
                    f"none: pass Result.{name} of a fit of the same sources"
                )
        if self.structures and not self.thetas:
            raise ValueError(
                "structures are given without thetas, about whose profiles they are: pass "
                "Result.thetas and Result.structures of one fit"
            )
        for i, own in enumerate(self.structures):
            for structure in () if own is None else own:
                if not (structure is None or _is_structure(structure)):
                    raise ValueError(
                        f"structures[{i}] has {reprlib.repr(structure)}, must have None or a "
                        "ComponentStructure of each component, with as many coefficients (ny, nx) "
                        "as strengths >= 0, all finite: pass Result.structures"
                    )
        for i, own in enumerate(self.thetas):
            for theta in () if own is None else own:
                if np.ndim(theta) != 1 or not np.isfinite(theta).all():
                    raise ValueError(
                        f"thetas[{i}] has {theta}, must have finite parameters (n,) of each "
                        "component: pass Result.thetas"
                    )

    def _check_work(self, frame):
        """Raises ValueError, before a fit starts, if it would exceed the limits on work."""
        n_pixels = int(np.prod(frame.shape, dtype=float))
        if n_pixels > MAX_PIXELS:
            raise ValueError(
                f"the model frame has {frame.shape[0]} x {frame.shape[1]} pixels, more than the "
                f"{MAX_PIXELS} of one fit: are the WCS right? If so, cut the field into blends"
            )
        n = sum(getattr(source, "n_components", 1) or 1 for source in self.sources)
        n_seen = max(int(np.count_nonzero(o.weights, axis=(1, 2)).max()) for o in self.observations)
        if n > n_seen > 0:
            raise ValueError(
                f"{len(self.sources)} sources have {n} components, but no channel has more than "
                f"{n_seen} pixels with weight: reduce the number of sources"
            )
        n_bytes = BYTES_A_BOX * n * min(n_pixels, BOX_PIXELS)
        n_bytes += BYTES_A_PIXEL * (n_pixels + sum(o.data.size for o in self.observations))
        if n > MAX_COMPONENTS or n_bytes > MAX_BYTES:
            raise ValueError(
                f"{len(self.sources)} sources with {n} components on {n_pixels} model pixels need "
                f"{n_bytes / 2**30:.3g} GiB in one fit, must be at most {MAX_COMPONENTS} "
                f"components and {MAX_BYTES >> 30} GiB: cut the field into blends for deblend_many"
            )

    def initial_shifts(self) -> np.ndarray:
        """Shifts (n_observations, 2) [model px], 0 where none are given.

        Raises ValueError for another shape, and for shifts that are not finite.
        """
        expected = len(self.observations), 2
        shifts = (
            np.zeros(expected) if self.shifts is None else as_float_array("shifts", self.shifts)
        )
        if shifts.shape != expected or not np.isfinite(shifts).all():
            raise ValueError(f"shifts is {shifts.tolist()}, must be {expected} finite numbers")
        return shifts

    def resolve_frame(self) -> Frame:
        """The frame of the blend, checked; see the class for that of one without.

        Raises ValueError for observations that do not fit together, for no sources, and for a
        profile of another shape than the frame.
        """
        self.check()
        if not self.sources:
            raise ValueError(
                "sources is empty, at least one is needed: where detect finds none there is "
                "nothing to fit; list sources, or pass detect a lower threshold"
            )
        if self.frame is None:
            frame = model_frame(self.observations)
            grown = grow_to_sources(frame, self.observations, self.sources, self.initial_shifts())
            frame = grown if np.prod(grown.shape, dtype=float) <= MAX_PIXELS else frame
        else:
            check_observations(self.observations)
            frame = self.frame
        self._check_work(frame)
        for i, source in enumerate(self.sources):
            profile = getattr(source, "profile", None)
            if profile is not None and np.shape(profile) != frame.shape:
                raise ValueError(
                    f"profile of source {i} has the shape {np.shape(profile)}, "
                    f"the model frame {frame.shape}"
                )
        return frame


def _is_structure(given):
    """Returns True for a ComponentStructure that a fit can go on from."""
    return (
        isinstance(given, ComponentStructure)
        and len(given.coefficients) == len(given.strengths)
        and all(np.ndim(z) == 2 and np.isfinite(z).all() for z in given.coefficients)
        and bool((np.isfinite(given.strengths) & (np.asarray(given.strengths) >= 0)).all())
    )


@dataclass(frozen=True)
class Failure:
    """A blend of a batch that could not be fitted.

    status: Ended.FAILED or INTERRUPTED; reason: of the failure; error: class of its exception
    """

    blend: Blend
    status: Ended
    reason: str = ""
    error: type[BaseException] | None = None

    converged = False
