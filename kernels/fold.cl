/* Images in four parts, even and odd about the middle of their rows and columns, and their spectra.
 *
 * A wave about the middle is a cos, which meets even parts alone, or a sin, which meets odd ones:
 * each part takes a quarter of the image and meets half of the waves, so that the transforms of all
 * four take half of the arithmetic.  Images are float, all else is REAL.
 *
 *   images: element (b, y, x) at offset + b * stride + y * ld + x * step (adjacent unless STRIDED)
 *   even, odd (2, n, half_y, n_pad): the parts even and odd along x; of each those even along y,
 *            then those odd.  Row and column i are i pixels off the middle, or i + 1/2 of an even
 *            number of pixels
 *   weight_y (2, half_y), weight_x (2, half_x): of the pixels after the middle, and of their
 *            partners before it: 0 of pixels that do not count. A middle pixel has no partner
 *
 * fold     the four parts of each image
 * unfold   the images of these parts, times their weights: the transpose of fold.  A middle pixel's
 *          odd parts must be 0
 * multiply z = D o z:  z (2, n, h_y, 2, h_pad), even and odd along y, then along x: the planes CC,
 *          CS, SC and SS of contract.cl's quads;  D (plans, n_bands, h_y, 4, h_pad) as MIX has it,
 *          image b has the D of band b % n_bands;  SIGN -1 conjugates D
 *
 * Launch: (X, half_y or h_y, n); X is 1 where a work-item walks a whole row (ROWS of group.h)
 */
#include "common.h"
#include "group.h"
#ifndef STRIDED     /* 1: an image's columns lie `step` apart; 0: they are adjacent */
#define STRIDED 0
#endif
#ifndef SIGN        /* of D's imaginary part: 1 forward, -1 adjoint */
#define SIGN 1
#endif

#if STRIDED
#define COLUMN(x) ((size_t)(x) * step)
#else
#define COLUMN(x) (x)
#endif

__kernel void fold(const int n_y, const int n_x, const int n_pad, const int n,
                   __global const float *restrict images, const ulong offset, const int stride,
                   const int ld, const int step,
                   __global const REAL *restrict weight_y, __global const REAL *restrict weight_x,
                   __global REAL *restrict even, __global REAL *restrict odd)
{
    const int half_y = (n_y + 1) / 2, half_x = (n_x + 1) / 2, i = (int)get_global_id(1);
    if (i >= half_y) return;
    const size_t b = get_global_id(2), part = (size_t)n * half_y * n_pad;
    const size_t to = (b * half_y + i) * n_pad;
    const REAL w_after = weight_y[i], w_before = weight_y[half_y + i];
    __global const float *image = images + offset + b * stride;
    __global const float *after = image + (size_t)(n_y / 2 + i) * ld;
    __global const float *before = image + (size_t)(n_y - 1 - n_y / 2 - i) * ld;
    FOR_X(j, half_x) {
        const int right = n_x / 2 + j, left = n_x - 1 - right;
        const REAL w_right = weight_x[j], w_left = weight_x[half_x + j];
        const REAL a = w_right * w_after * after[COLUMN(right)];
        const REAL b = w_left * w_after * after[COLUMN(left)];
        const REAL c = w_right * w_before * before[COLUMN(right)];
        const REAL d = w_left * w_before * before[COLUMN(left)];
        even[to + j] = (a + b) + (c + d);
        even[part + to + j] = (a + b) - (c + d);
        odd[to + j] = (a - b) + (c - d);
        odd[part + to + j] = (a - b) - (c - d);
    }
}

__kernel void unfold(const int n_y, const int n_x, const int n_pad, const int n,
                     __global float *restrict images, const ulong offset, const int stride,
                     const int ld, const int step,
                     __global const REAL *restrict weight_y, __global const REAL *restrict weight_x,
                     __global const REAL *restrict even, __global const REAL *restrict odd)
{
    const int half_y = (n_y + 1) / 2, half_x = (n_x + 1) / 2, i = (int)get_global_id(1);
    if (i >= half_y) return;
    const size_t b = get_global_id(2), part = (size_t)n * half_y * n_pad;
    const size_t from = (b * half_y + i) * n_pad;
    const REAL w_after = weight_y[i], w_before = weight_y[half_y + i];
    __global float *image = images + offset + b * stride;
    __global float *after = image + (size_t)(n_y / 2 + i) * ld;
    __global float *before = image + (size_t)(n_y - 1 - n_y / 2 - i) * ld;
    __global const REAL *ee = even + from, *oe = even + part + from;
    __global const REAL *eo = odd + from, *oo = odd + part + from;
    /* what lies after the middle last: of a middle pixel that is what counts */
    FOR_X(j, half_x) {
        const int right = n_x / 2 + j, left = n_x - 1 - right;
        const REAL w_right = weight_x[j], w_left = weight_x[half_x + j];
        const REAL even_sum = ee[j] + oe[j], even_rest = ee[j] - oe[j];
        const REAL odd_sum = eo[j] + oo[j], odd_rest = eo[j] - oo[j];
        before[COLUMN(left)] = (float)(w_left * w_before * (even_rest - odd_rest));
        before[COLUMN(right)] = (float)(w_right * w_before * (even_rest + odd_rest));
        after[COLUMN(left)] = (float)(w_left * w_after * (even_sum - odd_sum));
        after[COLUMN(right)] = (float)(w_right * w_after * (even_sum + odd_sum));
    }
}

__kernel void multiply(const int h_y, const int h_pad, const int n, const int n_bands,
                  __global const REAL *restrict D, __global REAL *restrict z)
{
    const int i = (int)get_global_id(1);
    if (i >= h_y) return;
    const size_t b = get_global_id(2), row = (size_t)2 * h_pad;
    __global const REAL *d = D + ((b % n_bands) * h_y + i) * 2 * row;
    __global REAL *c = z + (b * h_y + i) * row, *s = c + n * h_y * row;
    FOR_X(j, h_pad) {
        const REAL cc = c[j], cs = c[h_pad + j], sc = s[j], ss = s[h_pad + j];
        const REAL pr = d[j], pi = SIGN * d[h_pad + j];
        const REAL mr = d[2 * h_pad + j], mi = SIGN * d[3 * h_pad + j];
        const REAL fpr = cc - ss, fpi = -(cs + sc);     /* F(+nu_y, +nu_x) */
        const REAL fmr = cc + ss, fmi = cs - sc;        /* F(+nu_y, -nu_x) */
        const REAL gpr = pr * fpr - pi * fpi, gpi = pr * fpi + pi * fpr;
        const REAL gmr = mr * fmr - mi * fmi, gmi = mr * fmi + mi * fmr;
        c[j] = gpr + gmr;
        c[h_pad + j] = gmi - gpi;
        s[j] = -(gpi + gmi);
        s[h_pad + j] = gmr - gpr;
    }
}
