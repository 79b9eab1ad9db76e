"""Galaxies of the joint fits by magnitude: means in bins, and the numbers of a run."""

from __future__ import annotations

import numpy as np

from clresample.simulation.scenes import MAGNITUDE_RANGE

from ..harness.scenes import MODES

SINGLES = tuple(mode for mode in MODES if mode != "joint")
# Bins a side: as many as leave this many galaxies to a bin.
N_BINS, GALAXIES_PER_BIN = (9, 6, 3), 12
# [mag] A galaxy is called bright in a survey up to the middle of the range.
BRIGHT = sum(MAGNITUDE_RANGE) / 2
REGIONS = {
    "bright in both": (True, True),
    "bright in Euclid only": (True, False),
    "bright in Rubin only": (False, True),
    "faint in both": (False, False),
}


def bin_galaxies(galaxies, starts):
    """Means in bins of Euclid's magnitude (rows) and of the brightest in Rubin (columns).

    galaxies: name -> (n,): euclid_mag, rubin_mag, and SDRs of every start-mode
    returns edges (n + 1,), number (n, n), mean {start-mode: (n, n)}, and of joint minus each single
        mode gain and error, its standard error, {start-mode: (n, n)}; NaN where there is none
    """
    n_galaxies = len(galaxies["euclid_mag"])
    wanted = [n for n in N_BINS if n_galaxies >= GALAXIES_PER_BIN * n * n]
    n_bins = wanted[0] if wanted else N_BINS[-1]
    edges = np.linspace(*MAGNITUDE_RANGE, n_bins + 1)
    row, column = (
        np.clip(np.searchsorted(edges, galaxies[name], "right") - 1, 0, n_bins - 1)
        for name in ("euclid_mag", "rubin_mag")
    )
    cell = row * n_bins + column

    def table(values):
        return np.bincount(cell, values, n_bins**2).reshape(n_bins, n_bins)

    number = table(np.ones(n_galaxies))

    def mean_and_error(values):
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = table(values) / number
            variance = table((values - mean.ravel()[cell]) ** 2) / (number - 1)
            return mean, np.where(number > 1, np.sqrt(variance / number), np.nan)

    maps = {"edges": edges, "number": number, "mean": {}, "gain": {}, "error": {}}
    for start in starts:
        for mode in MODES:
            maps["mean"][f"{start}-{mode}"] = mean_and_error(galaxies[f"{start}-{mode}"])[0]
        for mode in SINGLES:
            gain = galaxies[f"{start}-joint"] - galaxies[f"{start}-{mode}"]
            name = f"{start}-{mode}"
            maps["gain"][name], maps["error"][name] = mean_and_error(gain)
    return maps


def summarise(galaxies, maps, starts):
    """Numbers of the run for its JSON: medians, shares, means by region, and the maps."""
    bright = [galaxies[name] <= BRIGHT for name in ("euclid_mag", "rubin_mag")]
    summary = {"n_galaxies": len(bright[0]), "starts": {}}
    for start in starts:
        sdr = {mode: galaxies[f"{start}-{mode}"] for mode in MODES}
        better = np.maximum(sdr["euclid"], sdr["rubin"])
        gains = {mode: sdr["joint"] - sdr[mode] for mode in SINGLES}
        gains["better"] = sdr["joint"] - better
        found = {
            "median": {mode: float(np.median(values)) for mode, values in sdr.items()},
            "wins": {name: float((gain > 0).mean()) for name, gain in gains.items()},
            "gain": {name: _mean(gain) for name, gain in gains.items()},
            "regions": {},
        }
        for name, (in_euclid, in_rubin) in REGIONS.items():
            here = (bright[0] == in_euclid) & (bright[1] == in_rubin)
            found["regions"][name] = {
                "n": int(here.sum()),
                "mean": {mode: _mean(values[here])["mean"] for mode, values in sdr.items()},
                "gain": {name: _mean(gain[here]) for name, gain in gains.items()},
            }
        summary["starts"][start] = found
    plain = {name: maps[name].tolist() for name in ("edges", "number")}
    for kind in ("mean", "gain", "error"):
        plain[kind] = {name: np.round(m, 3).tolist() for name, m in maps[kind].items()}
    return summary | {"maps": plain}


def _mean(values):
    """Mean and its standard error; NaN where there are too few values."""
    n = len(values)
    return {
        "mean": float(values.mean()) if n else np.nan,
        "error": float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else np.nan,
    }
