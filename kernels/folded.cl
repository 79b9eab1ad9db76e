/* The whole chain of an aligned operator for one image after the other, in even and odd parts.
 *
 *     target = unfold(Sy (D o (Ty fold(source) Tx)) Sx)
 *
 * A cosine about the middle of an image has products with even parts only, a sine with odd parts
 * only.  Each of the four parts of an image, even or odd along y and along x, has a quarter of its
 * size and is multiplied by half of the waves along each axis: half of the arithmetic in total.
 *
 * For CPUs: each of n work-items computes every n-th source, with its own scratch memory, which
 * stays in its core's cache, and tiles of MR rows and NV vectors in registers, as in contract.cl.
 * Images are float, all else is REAL.
 *
 *   images: element (b, y, x) at offset + b * stride + y * ld + x * step
 *   half_y, half_x: pixels from the middle on, ceil(n / 2); row and column i of a part lie i pixels
 *            off the middle, or i + 1/2 where there is an even number
 *   weight_y (2, half_y), weight_x (2, half_x): of these pixels, then of their partners before the
 *            middle: 0 for pixels to ignore, and for a middle pixel's partner
 *   wave_y of the source (2, h_y, half_y), of the target (2, half_y, h_y): cos, then sin
 *   wave_x of the source (2, half_x, h_pad), of the target (2, h_x, pad_x): likewise, zero-padded
 *   D (n_bands, h_y, 4, h_pad): planes as MIX of contract.cl has them; image b has the D of band
 *            b % n_bands.  SIGN -1 conjugates it: the adjoint
 *   scratch: stride_scratch elements for each work-item
 *     parts (2, 2, half_y, pad_x): even and odd along x, of each even and odd along y
 *     lines (2, half_y, 2, h_pad): their spectra along x, even and odd along y, cos and sin along x
 *     z (2, 2, h_y, 2, h_pad): the spectra, planes CC, CS, SC and SS of contract.cl's quads; then
 *            these times D
 *   n_seen: images of the target that each of the source makes; n_bands, or 1
 *
 * Launch: (work-items, 1, 1)
 */
#define KU 1        /* its sums are short: with 4, the remaining terms would cost the gain */
#include "contract.h"

#ifndef SPACED      /* 1: an image's columns lie `step` apart; 0: they are adjacent */
#define SPACED 0
#endif
#if SPACED
#define COLUMN(x) ((size_t)(x) * step)
#else
#define COLUMN(x) (x)
#endif

/* Sums of products C (m, n) = A (m, k) . B (k, n); n, ld_b and ld_c are whole vectors. */
INLINE void multiply(const int m, const int n, const int k, __global const REAL *A, const int ld_a,
                     __global const REAL *B, const int ld_b, __global REAL *C, const int ld_c)
{
    for (int j0 = 0; j0 < n; j0 += NV * VW) for (int i0 = 0; i0 < m; i0 += MR) {
        __global const REAL *row[MR];
        int column[NV];
        WIDE sums[MR][NV];
        UNROLL(v, NV) column[v] = j0 + v * VW < n ? j0 + v * VW : j0;
        UNROLL(i, MR) row[i] = A + (size_t)(i0 + i < m ? i0 + i : m - 1) * ld_a;
        SUM_INSIDE(n - j0, m - i0, sums, row, B, ld_b, column, k, k, 0)
        UNROLL(i, MR) UNROLL(v, NV)
            if (i0 + i < m && j0 + v * VW < n)
                AT(WIDE, C + (size_t)(i0 + i) * ld_c + column[v]) = sums[i][v];
    }
}

/* The four parts of an image. */
INLINE void fold(const int n_y, const int n_x, const int pad_x, __global const float *image,
                 const int ld, const int step, __global const REAL *weight_y,
                 __global const REAL *weight_x, __global REAL *parts)
{
    const int half_y = (n_y + 1) / 2, half_x = (n_x + 1) / 2;
    const size_t part = (size_t)half_y * pad_x;
    for (int i = 0; i < half_y; ++i) {
        const REAL w_after = weight_y[i], w_before = weight_y[half_y + i];
        __global const float *after = image + (size_t)(n_y / 2 + i) * ld;
        __global const float *before = image + (size_t)(n_y - 1 - n_y / 2 - i) * ld;
        __global REAL *to = parts + (size_t)i * pad_x;
        for (int j = 0; j < half_x; ++j) {
            const int right = n_x / 2 + j, left = n_x - 1 - right;
            const REAL w_right = weight_x[j], w_left = weight_x[half_x + j];
            const REAL a = w_right * (w_after * after[COLUMN(right)]);
            const REAL c = w_left * (w_after * after[COLUMN(left)]);
            const REAL b = w_right * (w_before * before[COLUMN(right)]);
            const REAL d = w_left * (w_before * before[COLUMN(left)]);
            to[j] = (a + b) + (c + d);
            to[part + j] = (a - b) + (c - d);
            to[2 * part + j] = (a + b) - (c + d);
            to[3 * part + j] = (a - b) - (c - d);
        }
    }
}

/* The image of four parts, of which a middle pixel's odd ones are 0: the transpose of fold. */
INLINE void unfold(const int n_y, const int n_x, const int pad_x, __global float *image,
                   const int ld, const int step, __global const REAL *weight_y,
                   __global const REAL *weight_x, __global const REAL *parts)
{
    const int half_y = (n_y + 1) / 2, half_x = (n_x + 1) / 2;
    const size_t part = (size_t)half_y * pad_x;
    for (int i = 0; i < half_y; ++i) {
        const REAL w_after = weight_y[i], w_before = weight_y[half_y + i];
        __global float *after = image + (size_t)(n_y / 2 + i) * ld;
        __global float *before = image + (size_t)(n_y - 1 - n_y / 2 - i) * ld;
        __global const REAL *from = parts + (size_t)i * pad_x;
        /* pixels after the middle last, since a middle pixel belongs to these */
        for (int j = 0; j < half_x; ++j) {
            const int left = n_x - 1 - n_x / 2 - j;
            const REAL w_left = weight_x[half_x + j];
            const REAL even = from[j] - from[2 * part + j];
            const REAL odd = from[part + j] - from[3 * part + j];
            before[COLUMN(left)] = (float)(w_left * w_before * (even - odd));
            after[COLUMN(left)] = (float)(w_left * w_after * (even + odd));
        }
        for (int j = 0; j < half_x; ++j) {
            const int right = n_x / 2 + j;
            const REAL w_right = weight_x[j];
            const REAL even = from[j] + from[2 * part + j];
            const REAL odd = from[part + j] + from[3 * part + j];
            before[COLUMN(right)] = (float)(w_right * w_before * (even - odd));
            after[COLUMN(right)] = (float)(w_right * w_after * (even + odd));
        }
    }
}

/* turned = D o z. */
INLINE void turn(const int h_y, const int h_pad, __global const REAL *D, __global const REAL *z,
                 __global REAL *turned)
{
    for (int i = 0; i < h_y; ++i) {
        __global const REAL *d = D + (size_t)i * 4 * h_pad;
        __global const REAL *c = z + (size_t)i * 2 * h_pad, *s = c + (size_t)h_y * 2 * h_pad;
        __global REAL *to_c = turned + (c - z), *to_s = turned + (s - z);
        for (int j = 0; j < h_pad; j += VW) {
            const WIDE cc = AT(const WIDE, c + j), cs = AT(const WIDE, c + h_pad + j);
            const WIDE sc = AT(const WIDE, s + j), ss = AT(const WIDE, s + h_pad + j);
            const WIDE pr = AT(const WIDE, d + j), pi = SIGN * AT(const WIDE, d + h_pad + j);
            const WIDE mr = AT(const WIDE, d + 2 * h_pad + j);
            const WIDE mi = SIGN * AT(const WIDE, d + 3 * h_pad + j);
            TIMES_TRANSFER(WIDE, pr, pi, mr, mi, cc, cs, sc, ss,
                           AT(WIDE, to_c + j), AT(WIDE, to_c + h_pad + j),
                           AT(WIDE, to_s + j), AT(WIDE, to_s + h_pad + j))
        }
    }
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void folded(const int n_sources, const int n_seen, const int n_bands,
            const int h_y, const int h_x, const int h_pad,
            const int n_y, const int n_x, const int pad_x,
            __global const float *restrict source, const ulong source_offset,
            const int source_stride, const int source_ld, const int source_step,
            __global const REAL *restrict weight_y, __global const REAL *restrict weight_x,
            __global const REAL *restrict wave_y, __global const REAL *restrict wave_x,
            const int to_n_y, const int to_n_x, const int to_pad_x,
            __global float *restrict target, const ulong target_offset, const int target_stride,
            const int target_ld, const int target_step,
            __global const REAL *restrict to_weight_y, __global const REAL *restrict to_weight_x,
            __global const REAL *restrict to_wave_y, __global const REAL *restrict to_wave_x,
            __global const REAL *restrict D, __global REAL *restrict scratch,
            const ulong stride_scratch, const ulong at_lines, const ulong at_z)
{
    const int half_y = (n_y + 1) / 2, half_x = (n_x + 1) / 2, ld = 2 * h_pad;
    const int to_half_y = (to_n_y + 1) / 2, to_half_x = (to_n_x + 1) / 2;
    __global REAL *parts = scratch + get_global_id(0) * stride_scratch;
    __global REAL *lines = parts + at_lines, *z = parts + at_z;
    __global REAL *turned = z + (size_t)2 * h_y * ld;
    for (int i = (int)get_global_id(0); i < n_sources; i += (int)get_global_size(0)) {
        fold(n_y, n_x, pad_x, source + source_offset + (size_t)i * source_stride, source_ld,
             source_step, weight_y, weight_x, parts);
        for (int odd = 0; odd < 2; ++odd)
            multiply(2 * half_y, h_pad, half_x, parts + (size_t)odd * 2 * half_y * pad_x, pad_x,
                     wave_x + (size_t)odd * half_x * h_pad, h_pad, lines + odd * h_pad, ld);
        for (int odd = 0; odd < 2; ++odd)
            multiply(h_y, ld, half_y, wave_y + (size_t)odd * h_y * half_y, half_y,
                     lines + (size_t)odd * half_y * ld, ld, z + (size_t)odd * h_y * ld, ld);
        for (int b = i * n_seen; b < (i + 1) * n_seen; ++b) {
            turn(h_y, h_pad, D + (size_t)(b % n_bands) * 2 * h_y * ld, z, turned);
            for (int odd = 0; odd < 2; ++odd)
                multiply(to_half_y, ld, h_y, to_wave_y + (size_t)odd * to_half_y * h_y, h_y,
                         turned + (size_t)odd * h_y * ld, ld,
                         lines + (size_t)odd * to_half_y * ld, ld);
            for (int odd = 0; odd < 2; ++odd)
                multiply(2 * to_half_y, to_pad_x, h_x, lines + odd * h_pad, ld,
                         to_wave_x + (size_t)odd * h_x * to_pad_x, to_pad_x,
                         parts + (size_t)odd * 2 * to_half_y * to_pad_x, to_pad_x);
            unfold(to_n_y, to_n_x, to_pad_x, target + target_offset + (size_t)b * target_stride,
                   target_ld, target_step, to_weight_y, to_weight_x, parts);
        }
    }
}
