"""Strengths of structure of all sources of a batch, and the solver's tables from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....device.multi_device import host_threads, map_threads
from .block_schedule import BlockSchedule
from .evidence import LocalPowerSpectra, SourceEvidence, blurred_light
from .exchange_direction import find_exchange_directions
from .inverse import BlockPreconditioner
from .response import OperatorResponse


@dataclass(frozen=True, eq=False)
class StrengthEstimates:
    """Strengths of one scene's n sources at J scales (n, J); meaningless for fixed sources.

    strengths: alpha; energies: |z|^2; n_effective: parameters that the data determine, gamma
    """

    strengths: np.ndarray
    energies: np.ndarray
    n_effective: np.ndarray


class PriorStrengths:
    """Present strengths of a batch's sources, estimated by their evidence.

    states (B): the scenes' States at their start, with initial strengths in their StructureState,
        if any
    past: other PriorStrengths and the indices (n,) of their scenes that continue here, which are
        all scenes

    values (S, J): alpha; meaningless for fixed sources
    significant (S,): sources whose finest structure is significant, see evidence.py
    precision (S, J): alpha^-2 on the device; light: a vector on the device, see lbfgs.cl
    schedule: BlockSchedule of the sources
    """

    def __init__(self, buffers, gradient, latents, prior, states=(), *, past=None):
        b = self.buffers = buffers
        self._scene = b.host_boxes.scene
        self._free = b.device.get(b.free)[: b.n_free]
        self._response = OperatorResponse(b, gradient)
        if past is None:
            self.values = np.tile(np.array(prior.strengths, float), (b.n_sources, 1))
            self._curvature = np.zeros_like(self.values)
            self.significant = np.zeros(len(self.values), bool)
            for i, state in enumerate(states):
                if state.learned is not None:
                    at = self._scene == i
                    self.values[at], self.significant[at] = (
                        state.learned.strengths,
                        state.learned.clear,
                    )
            self._evidence, inverses, self._light = self._prepare(prior)
            self.schedule = BlockSchedule(inverses, self._scene, b.device)
        else:
            other, keep = past
            kept = np.concatenate([np.flatnonzero(other._scene == i) for i in keep])
            self.values, self._curvature = other.values[kept], other._curvature[kept]
            self.significant = other.significant[kept]
            self._evidence = [other._evidence[i] for i in kept]
            self._light = [other._light[i] for i in kept]
            self.schedule = other.schedule.subset(kept, self._scene)
        self.precision = b.put(self.values**-2)
        self.light = b.put(latents.pack(self._light))

    def _prepare(self, prior):
        """Evidence, preconditioner and light [s][j] about the coefficients of each free source."""
        profiles = [p for s in self.buffers.scenes for p in s.profile]
        spectra = LocalPowerSpectra(prior)
        evidence, inverses = ([None] * len(profiles) for _ in range(2))
        light = [[np.zeros(0)] * len(prior.steps) for _ in profiles]
        answers, pixels = self._response.impulse_responses()
        pairs = zip(answers, pixels, strict=True)
        responses = [spectra.from_impulse_responses(*pair) for pair in pairs]

        def prepare(s):
            evidence[s] = SourceEvidence(spectra, prior, profiles[s], responses[self._scene[s]])
            light[s] = [
                blurred_light(profiles[s], sigma, step)
                for sigma, step in zip(prior.scales_px, prior.steps, strict=True)
            ]
            inverses[s] = BlockPreconditioner(evidence[s], profiles[s], light[s])

        map_threads(host_threads(self.buffers.device), prepare, self._free)
        return evidence, inverses, light

    def weights(self, spectra, due=None, change=0.0):
        """For `LbfgsSteps.reweigh` (S, J, 3): precision, curvature, change.

        spectra (S, C): at which the curvature is recomputed, in the scenes `due` (B,) or in all
        """
        for s in self._free if due is None else self._free_of(due):
            self._curvature[s] = self._evidence[s].curvature(spectra[s])
        precision = self.values**-2
        return np.stack([precision, self._curvature, precision * 0 + change], axis=2)

    def request_blocks(self, spectra, rounds, due=None):
        """Has blocks made for the present strengths and spectra (S, C), see BlockSchedule.

        rounds (B,): of the scenes; due (B,): the scenes whose blocks are made, None: all, which
            then count from now on
        """
        sources = self._free if due is None else self._free_of(due)
        self.schedule.request(sources, self.values, spectra, rounds)
        if due is None:
            self.schedule.take(rounds, sources)

    def take_blocks(self, rounds):
        """Takes blocks whose time has come; returns those of all sources (S) if any did."""
        return self.schedule.blocks if self.schedule.take(rounds) else None

    def find_exchanges(self, which, states):
        """Finds {scene: its ExchangeDirections} of the scenes `which` (B,) at their states (B)."""
        chosen, first = np.flatnonzero(which).tolist(), self.buffers.host_first
        parts = [slice(first[i], first[i + 1]) for i in chosen]

        def find(k):
            i, own = chosen[k], parts[k]
            given = self._evidence[own], self.values[own]
            found[i] = find_exchange_directions(self.buffers.scenes[i], states[i], *given)

        found = {}
        map_threads(host_threads(self.buffers.device), find, range(len(chosen)))
        return found

    def find_significant(self, due, energies, spectra):
        """Finds significant sources of the scenes `due` (B,); returns scenes (B,) with new ones."""
        found = np.zeros(len(due), bool)
        for s in self._free[due[self._scene[self._free]] & ~self.significant[self._free]]:
            given = self.values[s], energies[s], spectra[s]
            self.significant[s] = self._evidence[s].is_clear(*given)
            found[self._scene[s]] |= self.significant[s]
        return found

    def begin(self, which, powers, spectra):
        """Sets the strengths of the scenes `which` (B,) by `SourceEvidence.first_strengths`.

        powers (S, J): |dL/dz|^2 without structure; spectra (S, C)
        """
        for s in self._free_of(which):
            self.values[s] = self._evidence[s].first_strengths(powers[s], spectra[s])
        self._upload()

    def learn(self, due, energies, spectra):
        """New strengths of the scenes `due` (B,), from the residuals in the image buffers.

        energies (S, J): |z|^2; spectra (S, C)
        returns moved (B,): largest change of a ln alpha; the weights; change (B,) of the losses
        """
        chi2, old = self._response.misfit(spectra), self.values.copy()
        for s in self._free_of(due):
            given = old[s], energies[s], spectra[s], chi2[s]
            self.values[s] = self._evidence[s].learned(*given, clear=self.significant[s])
        change = self.values**-2 - old**-2
        self._upload()
        moved = np.zeros(len(due))
        np.maximum.at(moved, self._scene, np.abs(np.log(self.values / old)).max(1))
        loss = self._by_scene(0.5 * (energies * change).sum(1))
        return moved, self.weights(spectra, due, change), loss

    def findings(self, which, energies, spectra):
        """StrengthEstimates of the scenes `which` (B,), None for others; energies (S, J): |z|^2."""
        determined = np.zeros_like(self.values)
        for s in self._free_of(which):
            determined[s] = self._evidence[s].determined(self.values[s], spectra[s])
        parts = [self._scene == i if on else None for i, on in enumerate(which)]
        return [
            None
            if own is None
            else StrengthEstimates(self.values[own], energies[own], determined[own])
            for own in parts
        ]

    def by_scene(self):
        """(strengths (n, J), significance (n,) bool) of each scene's n components."""
        at = [self._scene == i for i in range(len(self.buffers.scenes))]
        return [(self.values[own], self.significant[own]) for own in at]

    def significant_scenes(self):
        """Selects scenes (B,) with sources whose finest structure is significant."""
        return self._by_scene(self.significant) > 0

    def _upload(self):
        precision = np.ascontiguousarray(self.values**-2, self.buffers.dtype)
        self.buffers.device.upload(precision, self.precision)

    def _free_of(self, which):
        """The free sources (n,) of the scenes `which` (B,)."""
        return self._free[which[self._scene[self._free]]]

    def _by_scene(self, values):
        """Sums (B,) over the scenes' sources."""
        return np.bincount(self._scene, values, len(self.buffers.scenes))
