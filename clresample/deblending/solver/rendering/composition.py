"""Spectra applied to the sources' boxed images, and the two gradients: the kernels of scene.cl."""

from __future__ import annotations


class Composition:
    """Sums over sources of one observation's frames, which any stage of rendering may have.

        frame[b, c] = sum_s A[s, c] boxed_s        d_boxed_s = sum_c A[s, c] frame[b, c] on the box
        dA[s, c] = <boxed_s, frame[b, c]>

    buffers: the batch; i_observation: whose bands; boxes: Boxes of the boxed images in frames of
    shape (ny, nx); transfer (buffer, elements of a scene): where frames are frequencies, which
    `compose` then multiplies by it
    """

    def __init__(self, buffers, i_observation, boxes, shape, transfer=None):
        b, (ny, nx) = buffers, shape
        part = b.scenes[0].channels()[i_observation]
        n_bands = part.stop - part.start
        group, n_images = b.tuning.sum_group, len(b.scenes) * n_bands
        shared = {
            "table": b.device.put(boxes.table),
            "n_channels": b.n_channels,
            "channel": part.start,
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
        self._compose.bind(first=b.first)
        self._morph, self._spectra = (
            launcher("gather_morph"),
            launcher("gather_spectra", (group, 1, 1)),
        )
        tallest, widest = boxes.shape.max(0).tolist()
        self._morph_size = b.sized(widest, tallest, 1)[:2]
        self._spectra_size = group, n_bands, len(boxes)

    def compose(self, boxed, spectra, frame):
        """Queue frame = sum_s A boxed_s, times the transfer function where there is one."""
        self._compose(self._compose_size, boxed=boxed, spectra=spectra, frame=frame)

    def gather_boxed(self, frame, spectra, d_boxed, active, *, add=False):
        """Queue d_boxed of the sources `active` (n,): written, or added to what is there."""
        self._morph(
            (*self._morph_size, active.size),
            active=active,
            frame=frame,
            spectra=spectra,
            add=add,
            d_boxed=d_boxed,
        )

    def gather_spectra(self, frame, boxed, d_spectra):
        """Queue dA of this observation's channels into d_spectra (S, C)."""
        self._spectra(self._spectra_size, frame=frame, boxed=boxed, d_spectra=d_spectra)
