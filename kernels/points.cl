/* Interpolation between a plane of rows and columns and pixels anywhere on it: distorted grids.
 *
 * plane_to_points   y[b, p] = sum_t,s weight[q, 0, t] weight[q, 1, s]
 *                             * plane[b, start[q, 0] + t, start[q, 1] + s],   q = rank[p]
 *                   0 where rank[p] is negative.
 *   Launch: (n_positions rounded up, batch); where ROWS are set, a work-item takes RUN pixels.
 * points_to_plane   plane[b, i, j] = sum_q weight[q, 0, i - start[q, 0]]
 *                             * weight[q, 1, j - start[q, 1]] * y[b, pixel[q]]
 *   Launch: (n_columns rounded up, n_rows, batch); where ROWS are set, (1, n_rows, batch).
 *
 *   plane (batch, n_rows, n_columns); y: image b at y_offset + b * n_positions
 *   rank (n_tables, n_positions), pixel (n_tables, n_most): of pixels in the order of their start
 *   start (n_tables, n_most, 2), weight (n_tables, n_most, 2, N_PAD): 0 from N_TAPS on
 *   first (n_tables, n_rows * n_columns + 1): number of pixels that start at earlier elements
 *
 * Item b uses table which[b / n_bands], or table 0 where there is only one.
 */
#include "common.h"

#ifndef N_TAPS      /* terms of a sum on each axis, and the same in whole vectors of four */
#define N_TAPS 10
#define N_PAD 12
#endif
#ifndef ROWS        /* 1: a work-item takes many pixels, as a CPU's vector unit wants it */
#define ROWS 0
#endif
#ifndef RUN         /* pixels of a work-item where ROWS are set */
#define RUN 64
#endif
/* Four neighbouring elements, which begin anywhere. */
typedef REAL FOUR __attribute__((ext_vector_type(4), aligned(sizeof(REAL))));
#define FOUR_AT(p) (*(__global FOUR *)(p))
#define FOUR_OF(p) (*(__global const FOUR *)(p))

/* The sum of one pixel, whose first element is `in`; w: weights of rows, then of columns. */
INLINE REAL at_point(__global const REAL *in, const int n_columns, __global const REAL *w)
{
#if ROWS
    FOUR sum[N_PAD / 4];
    UNROLL(i, N_PAD / 4) sum[i] = w[0] * FOUR_OF(in + 4 * i);
    for (int t = 1; t < N_TAPS; ++t)
        UNROLL(i, N_PAD / 4) sum[i] += w[t] * FOUR_OF(in + t * n_columns + 4 * i);
    FOUR all = sum[0] * FOUR_OF(w + N_PAD);
    UNROLL(i, N_PAD / 4 - 1) all += sum[i + 1] * FOUR_OF(w + N_PAD + 4 * i + 4);
    return (all.x + all.y) + (all.z + all.w);
#else
    REAL total = 0;
    for (int t = 0; t < N_TAPS; ++t) {
        REAL sum = 0;
        UNROLL(s, N_TAPS) sum += w[N_PAD + s] * in[t * n_columns + s];
        total += w[t] * sum;
    }
    return total;
#endif
}

__kernel void plane_to_points(const int n_positions, const int n_most, const int n_rows,
                              const int n_columns, const int n_bands, const int n_tables,
                              __global const int *restrict which,
                              __global const int *restrict rank,
                              __global const int *restrict start,
                              __global const REAL *restrict weight,
                              __global const REAL *restrict plane, __global REAL *restrict y,
                              const ulong y_offset)
{
    const int b = (int)get_global_id(1);
    const size_t i_table = n_tables > 1 ? which[b / n_bands] : 0;
    rank += i_table * n_positions;
    start += i_table * n_most * 2;
    weight += i_table * n_most * 2 * N_PAD;
    plane += (size_t)b * n_rows * n_columns;
    y += y_offset + (size_t)b * n_positions;
    const int first = (ROWS ? RUN : 1) * (int)get_global_id(0);
    const int last = min(first + (ROWS ? RUN : 1), n_positions);
    for (int p = first; p < last; ++p) {
        const int q = rank[p];
        REAL sum = 0;
        if (q >= 0)
            sum = at_point(plane + (size_t)start[2 * q] * n_columns + start[2 * q + 1], n_columns,
                           weight + (size_t)q * 2 * N_PAD);
        y[p] = sum;
    }
}

__kernel void points_to_plane(const int n_positions, const int n_most, const int n_rows,
                              const int n_columns, const int n_bands, const int n_tables,
                              __global const int *restrict which,
                              __global const int *restrict pixel,
                              __global const int *restrict first,
                              __global const int *restrict start,
                              __global const REAL *restrict weight, __global REAL *restrict plane,
                              __global const REAL *restrict y, const ulong y_offset)
{
    const int i = (int)get_global_id(1), b = (int)get_global_id(2);
    const size_t i_table = n_tables > 1 ? which[b / n_bands] : 0;
    pixel += i_table * n_most;
    first += i_table * ((size_t)n_rows * n_columns + 1);
    start += i_table * n_most * 2;
    weight += i_table * n_most * 2 * N_PAD;
    plane += ((size_t)b * n_rows + i) * n_columns;
    y += y_offset + (size_t)b * n_positions;
    const int top = max(i - N_TAPS + 1, 0);
#if ROWS
    /* the pixels of all rows above are neighbours in their order */
    for (int j = 0; j < n_columns; ++j) plane[j] = 0;
    const int end = first[(size_t)(i + 1) * n_columns];
    for (int q = first[(size_t)top * n_columns]; q < end; ++q) {
        __global const REAL *w = weight + (size_t)q * 2 * N_PAD;
        const REAL value = y[pixel[q]] * w[i - start[2 * q]];
        __global REAL *out = plane + start[2 * q + 1];
        UNROLL(s, N_PAD / 4) FOUR_AT(out + 4 * s) += value * FOUR_OF(w + N_PAD + 4 * s);
    }
#else
    const int j = (int)get_global_id(0);
    if (j >= n_columns) return;
    REAL sum = 0;
    for (int row = top; row <= i; ++row) {
        __global const int *cell = first + (size_t)row * n_columns;
        for (int q = cell[max(j - N_TAPS + 1, 0)]; q < cell[j + 1]; ++q) {
            __global const REAL *w = weight + (size_t)q * 2 * N_PAD;
            sum += y[pixel[q]] * w[i - row] * w[N_PAD + j - start[2 * q + 1]];
        }
    }
    plane[j] = sum;
#endif
}
