"""Display mix-ins of the public classes: repr, notebook card, figure.

Base classes without any state, one for each class that users meet.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from .card import card, format_values
from .deblended import deblended_figure
from .observations import detection_sheet, observation_figure, psf_figure


class GridDisplay:
    """A Grid's line and card."""

    def __repr__(self):
        place = "y {:.3f}, x {:.3f} arcsec" if self.is_flat else "{:.6f}, {:.6f} deg"
        middle = place.format(*_middle(self))
        return f"Grid({_pixels(self)}, {self.sky_description}, centred on {middle})"

    def _repr_html_(self):
        size = np.array(self.shape) * self.pixel_scale_arcsec
        unit = "y, x [arcsec]" if self.is_flat else "longitude, latitude [deg]"
        properties = {
            "pixels": _pixels(self),
            "size": f"{size[0]:.4g} x {size[1]:.4g} arcsec",
            f"centre, {unit}": format_values(_middle(self), ".8g"),
            "sky": self.sky_description,
        }
        return card("Grid", properties)


class PSFDisplay:
    """A PSF's line, card and figure."""

    def __repr__(self):
        n_bands, n_y, n_x = self.images.shape
        samples = f"{n_bands} of {n_y} x {n_x} samples, spacing {self.spacing:g} px"
        return f"PSF({samples}, FWHM {format_values(self.fwhm_px)} px)"

    def _repr_html_(self):
        n_bands, n_y, n_x = self.images.shape
        properties = {
            "bands": n_bands,
            "samples": f"{n_y} x {n_x}, {self.spacing:g} px apart",
            "FWHM [px]": format_values(self.fwhm_px),
            "centre (y, x) [samples]": format_values(self.center[0], ".5g"),
        }
        return card("PSF", properties, self.plot)

    def plot(self, *, title=""):
        """Every band, in four decades of brightness, crosses at the centres.

        returns matplotlib Figure. Raises ImportError, with what to install, without matplotlib.
        """
        return psf_figure(self, title)


class ObservationDisplay:
    """An Observation's line, card and figure."""

    def __repr__(self):
        return (
            f"Observation({self.label}: {format_values(self.channels, '')}; {_pixels(self.grid)})"
        )

    def _repr_html_(self):
        zero_points = self.zero_points
        properties = {
            "channels": " ".join(self.channels),
            "pixels": _pixels(self.grid),
            "unit": self.unit or "counts",
            "without weight": f"{np.mean(self.weights == 0):.2%}",
            "PSF, FWHM [px]": format_values(self.psf.fwhm_px),
            "zero points [mag]": "none"
            if zero_points is None
            else format_values(zero_points, ".5g"),
            "noise": "white" if self.noise is None else repr(self.noise[0]),
        }
        title = f"Observation {self.name or ''}"
        return card(title, properties | _notes(self.messages), self.plot)

    def plot(self, *, title=""):
        """Every channel, linear in the noise and logarithmic above; masked pixels are blank.

        returns matplotlib Figure. Raises ImportError, with what to install, without matplotlib.
        """
        return observation_figure(self, title)


class ResultDisplay:
    """A Result's length, that of its sources, line, card and figure."""

    def __len__(self):
        return len(self.sources)

    def __repr__(self):
        sources = f"{len(self.sources)} sources, {len(self.components)} components"
        return f"Result({sources}, {format_values(self.channels, '')}: {_ending(self)})"

    def _repr_html_(self):
        n_y, n_x = self.frame.shape
        properties = {
            "sources": f"{len(self.sources)}, {len(self.components)} components",
            "channels": " ".join(self.channels),
            "model frame": f"{n_y} x {n_x} px of {self.frame.grid.pixel_scale_arcsec:.4g} arcsec",
            "status": _ending(self),
            "seconds": f"{sum(self.seconds.values()):.2f}",
        }
        return card("Result", properties | _notes(self.messages), self.plot)

    def plot(self, *, title=""):
        """Observed, model and residual of every observation, three channels in colour.

        returns matplotlib Figure. Raises ImportError, with what to install, without matplotlib.
        """
        return deblended_figure(self, title=title)


class ShownDetection:
    """A Detection's length, line, card and figure."""

    def __len__(self):
        return len(self.sources)

    def __repr__(self):
        counts = ", ".join(f"{n} in {name}" for name, n in Counter(self.found_in).items())
        return f"Detection({len(self)} sources{f': {counts}' * bool(counts)}; {_heights(self)})"

    def _repr_html_(self):
        properties = {
            "sources": len(self),
            "peaks": _heights(self),
            **{f"found in {name}": n for name, n in Counter(self.found_in).items()},
            "frame": _pixels(self.frame.grid),
        }
        return card("Detection", properties, self.plot)

    def plot(self, *, title=""):
        """Signal to noise of all observations together, with the sources marked.

        returns matplotlib Figure. Raises ImportError, with what to install, without matplotlib.
        """
        return detection_sheet(self, title)


class CertificateDisplay:
    """A Certificate's card."""

    def _repr_html_(self):
        properties = {
            "light wraps at [model px]": format_values(self.wrap_radius_px),
            "padded to": f"{self.n_fft[0]} x {self.n_fft[1]}",
            "frequencies summed": f"{self.n_frequencies[0]} x {self.n_frequencies[1]}",
            "largest gain of noise": format_values(self.max_gain),
            "power floored": format_values(self.floored_power),
        }
        return card("Certificate", properties)


def _pixels(grid):
    n_y, n_x = grid.shape
    return f"{n_y} x {n_x} px of {grid.pixel_scale_arcsec:.4g} arcsec"


def _middle(grid):
    """The sky at a grid's centre (2,)."""
    return grid.sky(*(np.array(grid.shape) - 1) / 2)


def _ending(result):
    return f"{result.status} after {max(len(result.losses) - 1, 0)} iterations"


def _heights(detection):
    if not len(detection):
        return "no peaks"
    return f"peaks of {detection.peaks.min():.3g} to {detection.peaks.max():.3g} sigma"


def _notes(messages):
    return {f"note {i}": text for i, text in enumerate(messages, 1)}
