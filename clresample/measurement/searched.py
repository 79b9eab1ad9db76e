"""Sources of successive searches, with the bodies of large galaxies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .clumps import Bodies, bodies_of, small_bodies_of
from .companions import parabolic_peak
from .peaks import new_peaks

# [FWHM^2] least area of connected pixels above the threshold: smaller ones are not as wide as the
# PSF, but noise on top of light just below the threshold
MIN_AREA = 0.25
# [FWHM of the wider PSF] A peak nearer than this to a source counts as that source.
SAME_SOURCE = 0.7
# [px] Steps of positions between pixels, so that two searches of one source rarely differ by their
# rounding errors; below a signal to noise of 20 positions have larger errors. A position rounds to
# the pixel of its peak.
PART_PX, MAX_PART_PX = 1 / 16, 7 / 16


class Search:
    """Sources of the searches so far, and the bodies of large galaxies that contain them.

    positions (S), peaks (S) [sigma], labels (S), owners (S): number of a source's body, -1 = none
    """

    def __init__(self, sep, threshold, known):
        self.sep, self.threshold, self.known = sep, threshold, known
        self.positions: list[np.ndarray] = []
        self.peaks: list[float] = []
        self.labels: list[str] = []
        self.owners: list[int] = []
        self.clumps: list[np.ndarray] = []
        self.bodies = Bodies()
        self._tops: dict[tuple, np.ndarray] = {}  # of peaks, by their pixel

    def _put(self, position, peak, label, owner=-1):
        self.positions.append(position)
        self.peaks.append(peak)
        self.labels.append(label)
        self.owners.append(owner)

    def add(self, image, label, narrow, wide):
        """Adds the new peaks of an image, except those on bodies searched before."""
        before = self.known + self.positions + self.clumps
        area, apart = MIN_AREA * narrow**2, SAME_SOURCE * wide
        given, first = (image, self.threshold, area, wide, before, apart), not self.positions
        for position, peak in new_peaks(self.sep, *given, first=first):
            if self.bodies.body_at(position) < 0:
                self._put(position, peak, label)
                away = np.rint((parabolic_peak(image, position) - position) / PART_PX) * PART_PX
                self._tops[tuple(position)] = position + away.clip(-MAX_PART_PX, MAX_PART_PX)

    def sort_out(self, image, fwhm, scale):
        """Finds the bodies of the searched image and removes peaks that are their structure."""
        given = fwhm, self.threshold, scale
        self.bodies = bodies_of(image, np.array(self.positions), *given)
        self._with_small_bodies(image, given)
        if not self.bodies.bodies:
            return
        places, peaks, labels = self.positions, self.peaks, self.labels
        centers = [tuple(body.center) for body in self.bodies.bodies]
        self.positions, self.peaks, self.labels, self.owners = [], [], [], []
        for i, (place, peak, label) in enumerate(zip(places, peaks, labels, strict=True)):
            if tuple(place) in centers:
                continue
            if self.bodies.structure[i]:
                self.clumps.append(place)
            else:
                self._put(place, peak, label, int(self.bodies.owners[i]))
        own = {tuple(place): given for place, *given in zip(places, peaks, labels, strict=True)}
        for i, body in enumerate(self.bodies.bodies):
            y, x = body.center.astype(int)
            given = float(image[y, x]), labels[0]
            if body.clump == 0:  # faint or small: its centre is one of the peaks
                given = own.get(tuple(body.center), given)
            self._put(body.center, *given, i)

    def _with_small_bodies(self, image, given):
        """Adds the bodies of small galaxies among the peaks that belong to no body."""
        large = self.bodies
        centers = {tuple(body.center) for body in large.bodies}
        free = [
            i
            for i, (place, owner) in enumerate(zip(self.positions, large.owners, strict=True))
            if owner < 0 and not large.structure[i] and tuple(place) not in centers
        ]
        small = small_bodies_of(image, np.array(self.positions)[free], *given)
        owners = large.owners.copy()
        owners[free] = np.where(small.owners < 0, -1, small.owners + len(large.bodies))
        bodies, whole = list(large.bodies), [body.without_holes() for body in large.bodies]
        for body in small.bodies:
            rings = [b.group for b in whole if b.encloses(body.center, image)]
            group = rings[0] if rings else body.group + len(large.bodies)
            bodies.append(replace(body, group=group))
        self.bodies = replace(large, bodies=tuple(bodies), owners=owners)

    def add_companions(self, new, image, label):
        """Adds peaks beside others: positions and heights of an image's residual there."""
        for position, height in new:
            owner = self.bodies.body_at(position)
            if owner >= 0:
                y, x = np.rint(position).astype(int)
                is_clump, is_member = self.bodies.bodies[owner].takes(height, image[y, x] - height)
                if is_clump:
                    continue
                owner = owner if is_member else -1
            else:
                y, x = np.rint(position).astype(int)
                owner = self.bodies.group_at(position, height, image[y, x] - height)
            self._put(position, height, label, owner)

    def position_of(self, i):
        """Position (y, x) of a source: its peak between pixels where it is one of an image."""
        y, x = self._tops.get(tuple(self.positions[i]), self.positions[i])
        return float(y), float(x)

    def in_order(self):
        """Indices of the sources, brightest peak first, and the group of each, see Detection."""
        order = sorted(range(len(self.peaks)), key=lambda i: -self.peaks[i])
        centers = {tuple(b.center): i for i, b in enumerate(self.bodies.bodies)}
        center_of = {}
        for k, i in enumerate(order):
            body = centers.get(tuple(self.positions[i]))
            if body is not None:
                center_of[body] = k
        hosts = [body.group for body in self.bodies.bodies]
        of = [hosts[owner] if owner >= 0 else -1 for owner in self.owners]
        groups = [center_of.get(of[i], k) for k, i in enumerate(order)]
        return order, np.array(groups, int)
