/* The end of the contraction kernels and of mirror_to_waves.cl, pasted into their bodies: the
 * epilogue, then the stores.
 *
 * SUMS[MR][NV]: the sums of rows i0 + i and of the VW columns from column[v]
 * on. A kernel defines OWNED(i, v), whether they lie inside C, and STORE_LANES(sums, c, n_left),
 * which stores the lanes of a vector from c on, step_c apart, n_left of them at most.
 */
    if (MIX && E) EACH(h, MR / 2) EACH(v, NV) {
        const int i = 2 * h;
        if (!OWNED(i, v)) continue;
        const WIDE c = SUMS[i][v], s = SUMS[i + 1][v];
        const HALF pr = AT(const HALF, PLANE(h, 0, column[v]));
        const HALF pi = SIGN * AT(const HALF, PLANE(h, 1, column[v]));
        const HALF mr = AT(const HALF, PLANE(h, 2, column[v]));
        const HALF mi = SIGN * AT(const HALF, PLANE(h, 3, column[v]));
        const HALF fpr = EVEN(c) - ODD(s), fpi = -(ODD(c) + EVEN(s));   /* F(+nu_y, +nu_x) */
        const HALF fmr = EVEN(c) + ODD(s), fmi = ODD(c) - EVEN(s);      /* F(+nu_y, -nu_x) */
        const HALF gpr = pr * fpr - pi * fpi, gpi = pr * fpi + pi * fpr;
        const HALF gmr = mr * fmr - mi * fmi, gmi = mr * fmi + mi * fmr;
        EVEN(SUMS[i][v]) = gpr + gmr;
        ODD(SUMS[i][v]) = gmi - gpi;
        EVEN(SUMS[i + 1][v]) = -(gpi + gmi);
        ODD(SUMS[i + 1][v]) = gmr - gpr;
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
#if RAGGED
        __global REAL *c = C + (size_t)(i0 + i) * ld_c + (size_t)column[v] * step_c;
        STORE_LANES(SUMS[i][v], c, n - column[v])
#else
        AT(WIDE, C + (size_t)(i0 + i) * ld_c + column[v]) = SUMS[i][v];
#endif
    }
