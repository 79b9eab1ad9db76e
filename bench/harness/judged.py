"""Catalogues of simulated fields compared with their truth: completeness, purity, fluxes."""

from __future__ import annotations

import numpy as np

NEAR_PX, FOUND_PX = 8.0, 4.0  # [model px] of a neighbour, of a row that may be a source's own
EDGE_PX = 8  # sources so near to the edge are not judged: their light is not all there
SEEN_SNR = 5.0  # a neighbour with less signal to noise does not count


def matched(positions, truth):
    """For each true position the row that is its own, within FOUND_PX, or -1.

    Pairs are taken in the order of their distance, each row and each true source once: one row is
    never two sources, however close they are.
    """
    found = np.full(len(truth), -1)
    if not len(positions):
        return found
    apart = np.hypot(*(truth[:, None] - positions[None]).transpose(2, 0, 1))
    near = np.argwhere(apart < FOUND_PX)
    taken = set()
    for t, row in near[np.argsort(apart[tuple(near.T)], kind="stable")]:
        if found[t] < 0 and row not in taken:
            found[t] = row
            taken.add(row)
    return found


class Judged:
    """One field: which rows are whose, and which true sources are judged.

    at (R, 2), true (S, 2) [model px]: rows and true sources; snr (S,): of the best possible filter
    n_model: pixels a side of the field
    own (S,): row of each true source or -1
    nearest (S,) [px]: its nearest neighbour of SEEN_SNR or more
    alone, inner (S,) bool: no neighbour within NEAR_PX; not at the edge
    """

    def __init__(self, at, truth, n_model):
        self.at = np.asarray(at, float).reshape(-1, 2)
        self.true = np.stack([truth["y"], truth["x"]], axis=1)
        self.snr, self.n_model = np.asarray(truth["snr"]), n_model
        self.own = matched(self.at, self.true)
        apart = np.hypot(*(self.true[:, None] - self.true[None]).transpose(2, 0, 1))
        np.fill_diagonal(apart, np.inf)
        apart[:, self.snr < SEEN_SNR] = np.inf
        self.nearest = apart.min(axis=1, initial=np.inf)
        self.alone = self.nearest > NEAR_PX
        self.inner = self._inside(self.true)

    def _inside(self, places):
        return ((places > EDGE_PX) & (places < self.n_model - 1 - EDGE_PX)).all(axis=1)

    def found(self):
        """{what: (found, of how many)} of completeness, and rows that are no source's own."""
        snr, alone = self.snr, self.alone
        groups = {
            "completeness": alone & (snr > 20) & (snr <= 100),
            "faint": alone & (snr > 10) & (snr <= 20),
            "bright": alone & (snr > 100),
            "close": ~alone & (snr > 20),
        }
        counts = {
            name: (
                int((self.own[chosen & self.inner] >= 0).sum()),
                int((chosen & self.inner).sum()),
            )
            for name, chosen in groups.items()
        }
        nobodys = np.ones(len(self.at), bool)
        nobodys[self.own[self.own >= 0]] = False
        rows = self._inside(self.at)
        return counts | {"spurious": (int((nobodys & rows).sum()), int(rows.sum()))}

    def judged(self):
        """True sources (S,) bool whose fluxes are judged: found, over 20, without neighbour."""
        return (self.own >= 0) & self.alone & (self.snr > 20) & self.inner

    def pairs(self, least_px=0.0, most_px=NEAR_PX):
        """True sources (S,) bool, found and over 20, whose nearest neighbour is so near."""
        near = (self.nearest > least_px) & (self.nearest <= most_px)
        return (self.own >= 0) & near & (self.snr > 20) & self.inner


def shares(judged):
    """{what: share} of the counts of several fields together; NaN of nothing."""
    total: dict[str, np.ndarray] = {}
    for one in judged:
        for name, counts in one.found().items():
            total[name] = total.get(name, 0) + np.array(counts)
    return {name: float(n / of) if of else float("nan") for name, (n, of) in total.items()}


def fluxes(table, truth, chosen, own, channels):
    """Fluxes, errors and true fluxes (S', C) of the chosen sources in a catalogue."""
    rows = own[chosen]
    given = (
        np.stack([np.asarray(table[f"{kind}_{c}"].value, float)[rows] for c in channels], axis=1)
        for kind in ("flux", "flux_err")
    )
    return *given, np.stack([np.asarray(truth[f"flux_{c}"])[chosen] for c in channels], axis=1)


def typical(errors):
    """1.4826 median |error| of the finite ones, NaN of none.

    This is their scatter about zero; for a normal distribution without bias it is its standard
    deviation.
    """
    errors = np.abs(np.asarray(errors)[np.isfinite(errors)])
    return float(1.4826 * np.median(errors)) if errors.size else np.nan


def error_of_mean(values, i_scene):
    """Standard error of a mean over scenes, whose values hang together; i_scene: of each value."""
    good = np.isfinite(values)
    excess = np.bincount(i_scene[good], values[good] - values[good].mean())
    return float(np.sqrt((excess**2).sum()) / good.sum())


def robust(values):
    """1.4826 median absolute deviation of the finite values, NaN of none."""
    values = np.asarray(values)[np.isfinite(values)]
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if values.size else np.nan
