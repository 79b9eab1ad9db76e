"""Computes the inputs of the evidence: impulse responses, weights, misfit at each source."""

from __future__ import annotations

import functools

import numpy as np

from ..rendering.composition import SpectralComposition


class OperatorResponse:
    """The operators of a batch's LossGradient, applied to noise and misfit.

    buffers, gradient: the batch and its LossGradient, whose image buffers are overwritten
    weights: per observation R^T w (B, Co T, Ny, Nx) on the device; if the PSF varies, T > 1, and
        the first term is the PSF in the middle of the scene
    """

    def __init__(self, buffers, gradient):
        self.buffers, self._observations = buffers, gradient.observations
        self._pulls = buffers.zeros_like_spectra()
        self._squares, self._frames = [], []
        for i, o in enumerate(self._observations):
            square = buffers.scene_launcher("square")
            _, my, mx = o.op.shape_out
            self._squares.append(square.bind(my=my, mx=mx, image=o.image))
            shape = o.op.shape_in[1:]
            self._frames.append(SpectralComposition(buffers, i, buffers.host_boxes, shape))

    @functools.cached_property
    def weights(self):
        """Computed at first use: a batch whose strengths have settled does not need it."""
        b, found = self.buffers, []
        for i, o in enumerate(self._observations):
            weights = b.device.resident.stack([s.weights[i] for s in b.scenes], b.dtype)
            found.append(o.op.adjoint(weights))
        return found

    def impulse_responses(self):
        """R_c^T w R_c of one pixel per scene and channel, near the middle of the covered part.

        w: the median weight. B responses (C, Ny, Nx) without padding, and pixels (B, C, 2).
        """
        b, answers, pixels = self.buffers, [], []
        for i, o in enumerate(self._observations):
            covered, n_terms = b.device.get(self.weights[i]), o.op.n_terms
            at = np.array(
                [_middle(_unpadded(*pair)) for pair in zip(b.scenes, covered, strict=True)]
            )
            impulse = np.zeros(covered.shape, b.dtype)
            for image, scene, (y, x) in zip(impulse, b.scenes, at, strict=True):
                image[::n_terms, y, x] = [_median(w) for w in scene.weights[i]]
            answer = b.device.get(o.op.adjoint(o.op.forward(b.put(impulse))))[:, ::n_terms]
            answers.append(answer)
            pixels.append(np.repeat(at[:, None], answer.shape[1], axis=1))
        answers = np.concatenate(answers, axis=1)
        pairs = zip(b.scenes, answers, strict=True)
        return [_unpadded(*pair) for pair in pairs], np.concatenate(pixels, axis=1)

    def misfit(self, spectra):
        """chi2 per pixel (S,) within each source's light, from the residuals in the image buffers.

        <A^2 S, R^T w^2 r^2> / <A^2 S, R^T w>, of the residuals w r; spectra (S, C).
        """
        b, power = self.buffers, np.square(spectra)
        for o, square in zip(self._observations, self._squares, strict=True):
            n_bands, my, mx = o.op.shape_out
            square(b.sized(mx, my, n_bands * len(b.scenes)))
            o.rendering.back_project(o.image)
            o.rendering.gather_spectra(self._pulls)
        found = (power * b.device.get(self._pulls)).sum(1)
        for frames, weights in zip(self._frames, self.weights, strict=True):
            frames.gather_spectra(weights, b.morph, self._pulls)
        return found / np.maximum((power * b.device.get(self._pulls)).sum(1), 1e-30)


def _unpadded(scene, images):
    """The part of images (..., Ny, Nx) that is not padding of their scene's frame."""
    return images[..., : scene.unpadded_shape[0], : scene.unpadded_shape[1]]


def _middle(weights):
    """The pixel (y, x) at the centroid of images (Co, Ny, Nx) of weight."""
    image = np.maximum(weights.sum(0, dtype=np.float64), 0)
    total = max(image.sum(), 1e-30)
    along = [image.sum(1 - axis) @ np.arange(n) / total for axis, n in enumerate(image.shape)]
    return np.round(along).astype(int)


def _median(weights):
    """The median of the values above 0; 0 without any."""
    seen = weights[weights > 0]
    return float(np.median(seen)) if seen.size else 0.0
