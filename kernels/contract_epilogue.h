/* The end of the contraction kernels and of mirror_to_waves.cl, pasted into their bodies: the
 * epilogue, then the stores.
 *
 * SUMS[MR][NV]: the sums of rows i0 + i and of the VW columns from column[v] on. A kernel defines
 * OWNED(i, v), true if they lie inside C, and STORE_LANES(sums, c, n_left), which stores at most
 * n_left lanes of a vector from c on, step_c apart.
 */
    if (MIX && E) EACH(h, MR / 2) EACH(v, NV) {
        const int i = 2 * h;
        if (!OWNED(i, v)) continue;
        const WIDE c = SUMS[i][v], s = SUMS[i + 1][v];
        const HALF pr = AT(const HALF, PLANE(h, 0, column[v]));
        const HALF pi = SIGN * AT(const HALF, PLANE(h, 1, column[v]));
        const HALF mr = AT(const HALF, PLANE(h, 2, column[v]));
        const HALF mi = SIGN * AT(const HALF, PLANE(h, 3, column[v]));
        TIMES_TRANSFER(HALF, pr, pi, mr, mi, EVEN(c), ODD(c), EVEN(s), ODD(s),
                       EVEN(SUMS[i][v]), ODD(SUMS[i][v]), EVEN(SUMS[i + 1][v]), ODD(SUMS[i + 1][v]))
    }
    if (TWIST) EACH(h, MR / 2) EACH(v, NV) {
        const int i = 2 * h;
        if (!OWNED(i, v)) continue;
        const WIDE c = SUMS[i][v], s = SUMS[i + 1][v];
        const WIDE cos_t = AT(const WIDE, PLANE(h, 0, column[v]));
        const WIDE sin_t = SIGN * AT(const WIDE, PLANE(h, 1, column[v]));
        SUMS[i][v] = c * cos_t + s * sin_t;
        SUMS[i + 1][v] = s * cos_t - c * sin_t;
    }

    EACH(i, MR) EACH(v, NV) {
        if (!OWNED(i, v)) continue;
#if ON_CPU || RAGGED
        if (RAGGED) {
            __global REAL *c = C + (size_t)(i0 + i) * ld_c + (size_t)column[v] * step_c;
            STORE_LANES(SUMS[i][v], c, n - column[v])
            continue;
        }
#endif
        AT(WIDE, C + (size_t)(i0 + i) * ld_c + column[v]) = SUMS[i][v];
    }
