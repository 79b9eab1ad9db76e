/* Stages of the operator for grids that are rotated, sheared or distorted against each other.
 *
 * gather   out[b, l, p] = sum_t weight[l, t, p] * in[b, l, start[l, p] + t]
 *          One line at a time, both ways: from the columns of pass 1 to the observed pixels of a line
 *          (forward), and back (adjoint, with the transposed tables).
 *   in, out: element (b, l, p) at offset + b * stride + l * ld + p * step, so that lines may be rows
 *            or columns of an observed image.
 *   start (n_tables, n_lines, n_out), weight (n_tables, n_lines, N_TAPS, n_out)
 *   Taps of weight 0 stand for "outside" and may read any element of the line.
 *   Launch: (n_out rounded up to the local size, n_lines, batch).
 *
 * rowdot   y[b, p] = sum_x T[b, p, x] * E[p, x]          launch: (n_positions rounded up, batch)
 * rowscale T[b, p, x] = y[b, p] * E[p, x]                launch: (n_pad, n_positions, batch)
 *          The two ends of the any-position path: each observed pixel p has its own table row E[p].
 *   E (n_tables, n_positions, n_pad), T (batch, n_positions, n_pad): zero in the padding
 *
 * Item b uses table b / n_bands, or table 0 where there is only one.
 */
#include "common.h"

#ifndef N_TAPS      /* terms of a sum; a constant, so that the compiler unrolls it: twice as fast */
#define N_TAPS 10
#endif

__kernel void gather(const int n_out, const int n_lines, const int n_bands, const int n_tables,
                     __global const REAL *restrict in, const ulong in_offset, const int in_stride,
                     const int in_ld, const int in_step,
                     __global REAL *restrict out, const ulong out_offset, const int out_stride,
                     const int out_ld, const int out_step,
                     __global const int *restrict start, __global const REAL *restrict weight)
{
    const int p = (int)get_global_id(0), l = (int)get_global_id(1), b = (int)get_global_id(2);
    if (p >= n_out) return;
    const size_t i_line = (size_t)(n_tables > 1 ? b / n_bands : 0) * n_lines + l;
    weight += i_line * N_TAPS * n_out + p;
    in += in_offset + (size_t)b * in_stride + (size_t)l * in_ld
        + (size_t)start[i_line * n_out + p] * in_step;
    REAL sum = 0;
#pragma unroll
    for (int t = 0; t < N_TAPS; ++t) sum += weight[(size_t)t * n_out] * in[(size_t)t * in_step];
    out[out_offset + (size_t)b * out_stride + (size_t)l * out_ld + (size_t)p * out_step] = sum;
}

__kernel void rowdot(const int n_positions, const int n_pad, const int n_bands, const int n_tables,
                     __global REAL *restrict y, const ulong y_offset,
                     __global const REAL *restrict T, __global const REAL *restrict E)
{
    const int p = (int)get_global_id(0), b = (int)get_global_id(1);
    if (p >= n_positions) return;
    const size_t i_table = n_tables > 1 ? b / n_bands : 0;
    T += ((size_t)b * n_positions + p) * n_pad;
    E += (i_table * n_positions + p) * n_pad;
    REAL part[8] = {0, 0, 0, 0, 0, 0, 0, 0};       /* independent sums, so that they vectorise */
    for (int x = 0; x < n_pad; x += 8)
        for (int i = 0; i < 8; ++i) part[i] += T[x + i] * E[x + i];
    y[y_offset + (size_t)b * n_positions + p] = ((part[0] + part[1]) + (part[2] + part[3]))
                                              + ((part[4] + part[5]) + (part[6] + part[7]));
}

__kernel void rowscale(const int n_positions, const int n_pad, const int n_bands, const int n_tables,
                       __global const REAL *restrict y, const ulong y_offset,
                       __global REAL *restrict T, __global const REAL *restrict E)
{
    const int x = (int)get_global_id(0), p = (int)get_global_id(1), b = (int)get_global_id(2);
    const size_t i_table = n_tables > 1 ? b / n_bands : 0;
    T[((size_t)b * n_positions + p) * n_pad + x] =
        y[y_offset + (size_t)b * n_positions + p] * E[(i_table * n_positions + p) * n_pad + x];
}
