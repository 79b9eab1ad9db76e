"""Sums over the terms of operators whose PSF varies."""

from __future__ import annotations


class PSFTerms:
    """The sums over an executor's terms, at its frequencies, and the way back: kernels/terms.cl.

        Z = sum_t Z_t                        before the observed pixels, T images to one
        Z_t = conj(D_t) o Z                  the adjoint, with the transfer functions on the way

    executor: Executor of more than one term; its scratch "terms" holds Z_t, "frequencies" Z
    """

    def __init__(self, executor):
        e = self._executor = executor
        self._add, self._spread = (
            e.device.launcher(
                "terms.cl",
                name,
                dtype=e.dtype,
                local_size=e.tuning.local_size(3),
                ROWS=e.tuning.row_loops,
            )
            for name in ("sum_terms", "split_terms")
        )

    def bind(self, scratch):
        """Binds the executor's present intermediates."""
        e = self._executor
        buffer, stride, _ = e.tables(e.transfer)
        shared = {
            "n_terms": e.n_terms,
            "h_y": e.h_y,
            "n_pad": e.k_pad,
            "terms": scratch["terms"],
            "z": scratch["frequencies"],
        }
        self._add.bind(**shared)
        self._spread.bind(**shared, n_bands=e.n_bands, D=buffer, stride_d=stride)

    def add(self, n):
        """Queues the sums of `n` images."""
        self._run(self._add, n)

    def split(self, n):
        """Queues the terms of `n` images."""
        self._run(self._spread, n)

    def _run(self, launch, n):
        e = self._executor
        launch((1 if e.tuning.row_loops else e.k_pad // 2, e.h_y, n))
