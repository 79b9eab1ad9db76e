"""Spectra applied to the sources' boxed images, and the two gradients: the kernels of scene.cl."""

from __future__ import annotations

import numpy as np


class SpectralComposition:
    """Sums over sources of one observation's frames, which any stage of rendering may have.

        frame[b, c] = sum_s A[s, c] boxed_s        d_boxed_s = sum_c A[s, c] frame[b, c] on the box
        dA[s, c] = <boxed_s, frame[b, c]>

    buffers: the batch; i_observation: whose bands; boxes: Boxes of the boxed images in frames of
    shape (ny, nx); transfer (buffer, elements of a scene): where frames are frequencies, which
    `compose` then multiplies by it

    If the PSF varies, an observation of Co channels has Co * T frames, one for each of its
    operator's terms, in which a source has its spectrum times its coefficients
    (Scene.coefficients):

        frame[b, c, t] = sum_s A[s, c] shares[s, c, t] boxed_s
    """

    def __init__(self, buffers, i_observation, boxes, shape, transfer=None):
        b, (ny, nx) = buffers, shape
        part = b.scenes[0].channels()[i_observation]
        n_bands, n_channels, channel = part.stop - part.start, b.n_channels, part.start
        self._parts = None
        if b.scenes[0].shares_of(i_observation) is not None:
            self._parts = _TermSpectra(b, i_observation, part)
            n_bands = n_channels = self._parts.n_frames
            channel = 0
        group, n_images = b.tuning.sum_group, len(b.scenes) * n_bands
        shared = {
            "table": b.device.put(boxes.table),
            "n_channels": n_channels,
            "channel": channel,
            "n_bands": n_bands,
            "ny_frame": ny,
            "nx_frame": nx,
        }
        vector = b.tuning.tile["VW"]

        def launcher(name, local_size=None):
            return b.scene_launcher(name, local_size).bind(**shared)

        if transfer is None:
            self._compose = launcher("compose")
            self._compose_size = b.sized(nx, ny, n_images)
        else:
            self._compose = launcher("compose_frequencies")
            self._compose.bind(E=transfer[0], stride_e=transfer[1])
            self._compose_size = b.sized(nx // vector, ny // 2, n_images)
        self._compose.bind(first=b.first, order=b.order)
        self._morph, self._spectra = (
            launcher("gather_morph"),
            launcher("gather_spectra", (group, 1, 1)),
        )
        self._morph_size = b.strided_rows(boxes.shape, 1)[:2]
        self._spectra.bind(active=b.all_sources)
        self._spectra_size = group, n_bands, b.all_sources.size

    def compose(self, boxed, spectra, frame):
        """Queues frame = sum_s A boxed_s, times the transfer function where there is one."""
        if self._parts is not None:
            spectra = self._parts.of(spectra)
        self._compose(self._compose_size, boxed=boxed, spectra=spectra, frame=frame)

    def gather_boxed(self, frame, spectra, d_boxed, active, *, add=False):
        """Queues d_boxed of the sources `active` (n,): written, or added to what is there."""
        if self._parts is not None:
            spectra = self._parts.of(spectra)
        self._morph(
            (*self._morph_size, active.size),
            active=active,
            frame=frame,
            spectra=spectra,
            add=add,
            d_boxed=d_boxed,
        )

    def gather_spectra(self, frame, boxed, d_spectra):
        """Queues dA of this observation's channels into d_spectra (S, C)."""
        found = d_spectra if self._parts is None else self._parts.d_parts
        self._spectra(self._spectra_size, frame=frame, boxed=boxed, d_spectra=found)
        if self._parts is not None:
            self._parts.gather(d_spectra)


class _TermSpectra:
    """Spectra of one observation's terms, (S, Co * T): split_spectra, merge_spectra of scene.cl.

    buffers: the batch; i: which observation; channels: slice of all
    """

    def __init__(self, buffers, i, channels):
        b = buffers
        shares = np.concatenate([scene.shares_of(i) for scene in b.scenes])
        n_sources, n_bands, n_terms = shares.shape
        self.n_frames = n_bands * n_terms
        self._spectra, self.d_parts = (
            b.device.empty((n_sources, self.n_frames), b.dtype) for _ in range(2)
        )
        self._share, self._unshare = (
            b.scene_launcher(name).bind(
                n_terms=n_terms,
                n_bands=n_bands,
                n_channels=b.n_channels,
                channel=channels.start,
                shares=b.put(shares),
            )
            for name in ("split_spectra", "merge_spectra")
        )
        self._size = b.sized(n_bands, n_sources, 1)
        self._share.bind(n_sources=n_sources)
        self._unshare.bind(n_sources=n_sources)

    def of(self, spectra):
        """Queues those of spectra (S, C), and returns them."""
        self._share(self._size, spectra=spectra, parts=self._spectra)
        return self._spectra

    def gather(self, d_spectra):
        """Queues dA of this observation's channels into d_spectra (S, C), from `d_parts`."""
        self._unshare(self._size, parts=self.d_parts, spectra=d_spectra)
