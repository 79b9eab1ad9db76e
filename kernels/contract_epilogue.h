/* The end of the contraction kernels and of mirror_to_waves.cl, pasted into their bodies: the
 * epilogue, then the stores.
 *
 * acc[MR][NV]: the sums of rows i0 + i and of the VW columns from column[v] on. A kernel defines
 * OWNED(i, v), true if they lie inside C, and STORE_LANES(sums, c, n_left), which stores at most
 * n_left lanes of a vector from c on, step_c apart.
 */
#if MIX
    if (E) UNROLL(h, MR / 2) UNROLL(v, NV) {
        const int i = 2 * h;
        if (!OWNED(i, v)) continue;
        const HALF pr = AT(const HALF, PLANE(h, 0, column[v]));
        const HALF pi = SIGN * AT(const HALF, PLANE(h, 1, column[v]));
        const HALF mr = AT(const HALF, PLANE(h, 2, column[v]));
        const HALF mi = SIGN * AT(const HALF, PLANE(h, 3, column[v]));
        const WIDE c = acc[i][v], s = acc[i + 1][v];
        TIMES_TRANSFER(HALF, pr, pi, mr, mi, EVEN(c), ODD(c), EVEN(s), ODD(s),
                       EVEN(acc[i][v]), ODD(acc[i][v]), EVEN(acc[i + 1][v]), ODD(acc[i + 1][v]))
    }
#elif TWIST
    UNROLL(h, MR / 2) UNROLL(v, NV) {
        const int i = 2 * h;
        if (!OWNED(i, v)) continue;
        const WIDE c = acc[i][v], s = acc[i + 1][v];
        const WIDE cos_t = AT(const WIDE, PLANE(h, 0, column[v]));
        const WIDE sin_t = SIGN * AT(const WIDE, PLANE(h, 1, column[v]));
        acc[i][v] = c * cos_t + s * sin_t;
        acc[i + 1][v] = s * cos_t - c * sin_t;
    }
#endif

    UNROLL(i, MR) UNROLL(v, NV) {
        if (!OWNED(i, v)) continue;
#if RAGGED
        __global REAL *c = C + (size_t)(i0 + i) * ld_c + (size_t)column[v] * step_c;
        STORE_LANES(acc[i][v], c, n - column[v])
#else
        AT(WIDE, C + (size_t)(i0 + i) * ld_c + column[v]) = acc[i][v];
#endif
    }
