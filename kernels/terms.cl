/* Frequencies of images with varying PSFs: sums over the terms of a PSF basis, for bands that are
 * the sum of T images of the model, and for boxes, each with its own sum.
 *
 *   z (n, 2 h_y, n_pad): of each of n images of the observation, n_bands of them for each plan
 *   terms (n, T, 2 h_y, n_pad): its terms.  Both consist of quads, see transfer.h
 *
 * sum_terms      z = sum_t terms[t]
 * split_terms   terms[t] = conj(D_t) o z;  D (plans, n_bands, T, h_y, 4, n_pad / 2) as MIX has it,
 *          stride_d: elements from a plan's to the next
 *
 * apply_transfer  z = D o phase o z0: n_bands transforms from one, shifted by the slot's offset:
 *          z0 (items, 2 h_y, n_pad), z (items * n_bands, 2 h_y, n_pad).  D of the item's plan has
 *          TERMS for each band, which are summed with the slot's shares (slots, n_bands, TERMS),
 *          not read if there is one term.  phase (slots, h_y + n_pad / 2, 2): cos and sin by row
 *          and by column.  Item i belongs to slot first + i / n; if there are several plans, its D
 *          is that of which[i];  launch: (X, h_y, items * n_bands)
 *
 * Launch: (X, h_y, n); X is 1 where a work-item walks a whole row (ROWS of work_group.h), else
 *     n_pad / 2
 */
#include "common.h"
#include "transfer.h"
#include "work_group.h"
#ifndef TERMS       /* of each band's transfer function, in turn */
#define TERMS 1
#endif

__kernel void sum_terms(const int n_terms, const int h_y, const int n_pad,
                  __global const REAL *restrict terms, __global REAL *restrict z)
{
    const size_t image = get_global_id(2), plane = (size_t)2 * h_y * n_pad;
    FOR_Y(i, h_y) {
        const size_t row = (size_t)2 * i * n_pad;
        __global const REAL *in = terms + image * n_terms * plane + row;
        __global REAL *out = z + image * plane + row;
        FOR_X(j, n_pad / 2) for (int k = 0; k < 4; ++k) {
            const size_t at = (size_t)(k / 2) * n_pad + 2 * j + k % 2;
            REAL sum = 0;
            for (int t = 0; t < n_terms; ++t) sum += in[t * plane + at];
            out[at] = sum;
        }
    }
}

__kernel void split_terms(const int n_terms, const int h_y, const int n_pad, const int n_bands,
                     __global const REAL *restrict D, const int stride_d,
                     __global const REAL *restrict z, __global REAL *restrict terms)
{
    const size_t image = get_global_id(2), plane = (size_t)2 * h_y * n_pad;
    const int n_half = n_pad / 2;
    D += image / n_bands * stride_d + image % n_bands * n_terms * plane;
    FOR_Y(i, h_y) {
        const size_t row = (size_t)2 * i * n_pad;
        __global const REAL *in = z + image * plane + row;
        FOR_X(j, n_half) {
            const REAL cc = in[2 * j], cs = in[2 * j + 1];
            const REAL sc = in[n_pad + 2 * j], ss = in[n_pad + 2 * j + 1];
            for (int t = 0; t < n_terms; ++t) {
                __global const REAL *d = D + t * plane + row + j;
                __global REAL *out = terms + (image * n_terms + t) * plane + row + 2 * j;
                const REAL pr = d[0], pi = -d[n_half], mr = d[2 * n_half], mi = -d[3 * n_half];
                TIMES_TRANSFER(REAL, pr, pi, mr, mi, cc, cs, sc, ss,
                               out[0], out[1], out[n_pad], out[n_pad + 1])
            }
        }
    }
}

__kernel void apply_transfer(const int h_y, const int n_pad, const int n_bands, const int n,
        const int first,
                   __global const REAL *restrict z0, __global const REAL *restrict phase,
                   const int n_plans, __global const int *restrict which,
                   __global const REAL *restrict D, __global const REAL *restrict shares,
                   __global REAL *restrict z)
{
    const int i = (int)get_global_id(1), band = (int)get_global_id(2) % n_bands;
    const int item = (int)get_global_id(2) / n_bands, n_half = n_pad / 2;
    if (i >= h_y) return;   /* launches are rounded up to whole groups */
    __global const REAL *t = phase + (size_t)(first + item / n) * 2 * (h_y + n_half);
    const REAL yr = t[2 * i], yi = t[2 * i + 1];
    __global const REAL *along = t + 2 * h_y;
    const size_t first_band = (size_t)(n_plans > 1 ? which[item] : 0) * n_bands;
    __global const REAL *d = D + ((first_band + band) * TERMS * h_y + i) * 4 * n_half;
#if TERMS > 1
    const size_t plane = (size_t)h_y * 4 * n_half;
    __global const REAL *share = shares + ((size_t)(first + item / n) * n_bands + band) * TERMS;
#endif
    __global const REAL *in = z0 + ((size_t)item * h_y + i) * 2 * n_pad;
    __global REAL *out = z + ((size_t)get_global_id(2) * h_y + i) * 2 * n_pad;
    FOR_X(j, n_half) {
        const REAL cc = in[2 * j], cs = in[2 * j + 1];
        const REAL sc = in[n_pad + 2 * j], ss = in[n_pad + 2 * j + 1];
        const REAL xr = along[2 * j], xi = along[2 * j + 1];
        const REAL tpr = yr * xr - yi * xi, tpi = yr * xi + yi * xr;    /* at (+nu_y, +nu_x) */
        const REAL tmr = yr * xr + yi * xi, tmi = yi * xr - yr * xi;    /* at (+nu_y, -nu_x) */
        REAL dpr = d[j], dpi = d[n_half + j], dmr = d[2 * n_half + j], dmi = d[3 * n_half + j];
#if TERMS > 1
        dpr *= share[0]; dpi *= share[0]; dmr *= share[0]; dmi *= share[0];
        for (int t = 1; t < TERMS; ++t) {
            __global const REAL *more = d + t * plane + j;
            dpr += share[t] * more[0];
            dpi += share[t] * more[n_half];
            dmr += share[t] * more[2 * n_half];
            dmi += share[t] * more[3 * n_half];
        }
#endif
        const REAL pr = dpr * tpr - dpi * tpi, pi = dpr * tpi + dpi * tpr;
        const REAL mr = dmr * tmr - dmi * tmi, mi = dmr * tmi + dmi * tmr;
        TIMES_TRANSFER(REAL, pr, pi, mr, mi, cc, cs, sc, ss,
                       out[2 * j], out[2 * j + 1], out[n_pad + 2 * j], out[n_pad + 2 * j + 1])
    }
}
