/* Stages of the operator for grids that are rotated or sheared against each other.
 *
 * gather   target[b, l, p] = sum_t weight[l, t, p] * source[b, l, start[l, p] + t]
 *          Line by line, in both directions: from the columns of pass 1 to the observed pixels of a
 *          line (forward), and back (adjoint, with the transposed tables).
 *   source, target: element (b, l, p) at offset + b * stride + l * ld + p * step, so that lines
 *            may be rows or columns of an observed image.
 *   start (n_tables, n_lines, n_out), weight (n_tables, n_lines, N_TAPS, n_out) or, where ROWS are
 *            set, (n_tables, n_lines, n_out, N_TAPS)
 *   Taps of weight 0 mean "outside" and may read any element of the line.
 *   Launch: (n_out rounded up to the local size, n_lines, batch), or, where ROWS are set and a
 *            work-item takes a line of all bands of a scene, whose taps it reads once for all of
 *            them, (1, n_lines, batch / n_bands).
 *
 * rowdot   y[b, p] = sum_x<n T[b, p, x] * E[p, x]        launch: (n_positions rounded up, batch)
 * rowscale T[b, p, x] = y[b, p] * E[p, x]                launch: (elements rounded up, batch)
 *          Sums at any positions: each position p has a table row E[p] of its own.
 *   E (n_tables, n_positions, n_pad), T (batch, n_positions, n_pad): zero from n on, of which
 *   rowdot reads whole eights
 *
 * Item b uses table b / n_bands, or table 0 where there is only one; in gather which[b / n_bands].
 */
#include "common.h"

#ifndef N_TAPS      /* terms of a sum; a constant, so that the compiler unrolls it: twice as fast */
#define N_TAPS 10
#endif
#ifndef ROWS        /* 1: a work-item walks a whole line, as a CPU's vector unit wants it */
#define ROWS 0
#endif
#if ROWS && N_TAPS % 4 == 0
/* Four neighbouring elements, which begin anywhere. */
typedef REAL FOUR __attribute__((ext_vector_type(4), aligned(sizeof(REAL))));
#define FOUR_AT(p) (*(__global const FOUR *)(p))
#endif

__kernel void gather(const int n_out, const int n_lines, const int n_bands, const int n_tables,
                     __global const REAL *restrict source, const ulong source_offset,
                     const int source_stride, const int source_ld, const int source_step,
                     __global REAL *restrict target, const ulong target_offset,
                     const int target_stride, const int target_ld, const int target_step,
                     __global const int *restrict which, __global const int *restrict start,
                     __global const REAL *restrict weight)
{
    const int l = (int)get_global_id(1);
#if ROWS
    const int k = (int)get_global_id(2);
    const size_t i_line = (size_t)(n_tables > 1 ? which[k] : 0) * n_lines + l;
    start += i_line * n_out;
    weight += i_line * N_TAPS * n_out;
    source += source_offset + (size_t)k * n_bands * source_stride + (size_t)l * source_ld;
    target += target_offset + (size_t)k * n_bands * target_stride + (size_t)l * target_ld;
    for (int c = 0; c < n_bands; ++c, source += source_stride, target += target_stride) {
        int p = 0;
#if N_TAPS % 4 == 0
        /* four pixels at a time, their taps side by side, where these are neighbours */
        for (; source_step == 1 && p + 4 <= n_out; p += 4) {
            FOUR sum[4];
            UNROLL(i, 4) {
                __global const REAL *in = source + start[p + i], *w = weight + (p + i) * N_TAPS;
                sum[i] = FOUR_AT(w) * FOUR_AT(in);
                UNROLL(t, N_TAPS / 4 - 1)
                    sum[i] += FOUR_AT(w + 4 * t + 4) * FOUR_AT(in + 4 * t + 4);
            }
            const FOUR even = {sum[0].x, sum[1].x, sum[2].x, sum[3].x};
            const FOUR odd = {sum[0].y, sum[1].y, sum[2].y, sum[3].y};
            const FOUR third = {sum[0].z, sum[1].z, sum[2].z, sum[3].z};
            const FOUR last = {sum[0].w, sum[1].w, sum[2].w, sum[3].w};
            const FOUR all = (even + odd) + (third + last);
            __global REAL *out = target + (size_t)p * target_step;
            out[0] = all.x;
            out[target_step] = all.y;
            out[2 * target_step] = all.z;
            out[3 * target_step] = all.w;
        }
#endif
        for (; p < n_out; ++p) {
            REAL sum = 0;
            for (int t = 0; t < N_TAPS; ++t)
                sum += weight[p * N_TAPS + t] * source[(start[p] + t) * source_step];
            target[(size_t)p * target_step] = sum;
        }
    }
#else
    const int p = (int)get_global_id(0), b = (int)get_global_id(2);
    if (p >= n_out) return;
    const size_t i_line = (size_t)(n_tables > 1 ? which[b / n_bands] : 0) * n_lines + l;
    weight += i_line * N_TAPS * n_out + p;
    source += source_offset + (size_t)b * source_stride + (size_t)l * source_ld
            + (size_t)start[i_line * n_out + p] * source_step;
    REAL sum = 0;
#pragma unroll
    for (int t = 0; t < N_TAPS; ++t)
        sum += weight[(size_t)t * n_out] * source[(size_t)t * source_step];
    target += target_offset + (size_t)b * target_stride + (size_t)l * target_ld;
    target[(size_t)p * target_step] = sum;
#endif
}

__kernel void rowdot(const int n_positions, const int n_pad, const int n, const int n_bands,
                     const int n_tables, __global REAL *restrict y, const ulong y_offset,
                     __global const REAL *restrict T, __global const REAL *restrict E)
{
    const int p = (int)get_global_id(0), b = (int)get_global_id(1);
    if (p >= n_positions) return;
    const size_t i_table = n_tables > 1 ? b / n_bands : 0;
    T += ((size_t)b * n_positions + p) * n_pad;
    E += (i_table * n_positions + p) * n_pad;
    REAL part[8] = {0, 0, 0, 0, 0, 0, 0, 0};       /* independent sums, so that they vectorise */
    for (int x = (n - 1) / 8 * 8; x >= 0; x -= 8)  /* low frequencies, the largest terms, last */
        for (int i = 0; i < 8; ++i) part[i] += T[x + i] * E[x + i];
    y[y_offset + (size_t)b * n_positions + p] = SUM8(part);
}

__kernel void rowscale(const int n_positions, const int n_pad, const int n_bands,
                       const int n_tables, __global const REAL *restrict y, const ulong y_offset,
                       __global REAL *restrict T, __global const REAL *restrict E)
{
    /* pixels along the first axis: GPUs take at most 65,535 groups along the others */
    const size_t i = get_global_id(0), p = i / n_pad, x = i % n_pad;
    const int b = (int)get_global_id(1);
    if (p >= n_positions) return;
    const size_t i_table = n_tables > 1 ? b / n_bands : 0;
    T[((size_t)b * n_positions + p) * n_pad + x] =
        y[y_offset + (size_t)b * n_positions + p] * E[(i_table * n_positions + p) * n_pad + x];
}
