"""Structure at several scales plainly in NumPy float64: what structure.cl must give."""

import numpy as np


def kernel(n_pixels, taps, step):
    """K_j along one axis (n_pixels, n coefficients).

    They are the taps about every step-th pixel, times the square root of the step.
    """
    n, radius = (n_pixels + step - 2) // step + 1, len(taps) // 2
    away = np.arange(n_pixels)[:, None] - step * np.arange(n)
    near = np.abs(away) <= radius
    return np.where(near, taps[np.clip(away + radius, 0, 2 * radius)], 0) * np.sqrt(step)


def gauged(image, profile):
    """An image without its part along the profile."""
    return image - profile * (profile * image).sum() / (profile * profile).sum()


class Source:
    """One source's profile (ny, nx) with a MultiscalePrior."""

    def __init__(self, profile, prior):
        self.profile, self.amp = profile, prior.amplitude(profile)
        self.axes = [
            tuple(kernel(n, taps, step) for n in profile.shape)
            for taps, step in zip(prior.kernels(), prior.steps, strict=True)
        ]

    def structure(self, z):
        """u of coefficients z (J): arrays."""
        return self.amp * sum(ky @ zj @ kx.T for zj, (ky, kx) in zip(z, self.axes, strict=True))

    def morph(self, z):
        """S."""
        return np.maximum(self.profile + gauged(self.structure(z), self.profile), 0)

    def gradient(self, d_morph, morph, z, precision):
        """dL/dz_j + precision_j z_j from dL/dS."""
        q = self.amp * gauged(np.where(morph > 0, d_morph, 0), self.profile)
        return [
            ky.T @ q @ kx + p * zj for p, zj, (ky, kx) in zip(precision, z, self.axes, strict=True)
        ]
