/* Shifts by complex exponentials, and the two ends of the contraction that follows them.
 *
 *   shift_line    G[(y, k), n] = F(y, nu_k) w_x[k, n]           F: model transformed along x alone
 *   shift_plane   G[(l, k, +-), n] = F(nu_l, +-nu_k) w_y[l, n] w_x[k, n]^(+-1)    F: along y and x
 *                 w[k, n] = exp(2 pi i nu_k X_n): displacement X of step n along one model axis
 *   unshift_*     the adjoints: sums over n, from G back to F
 *
 *   Z   frequencies F as real sums.  Line: row y, columns 2k, 2k+1 = the sums with cos and sin,
 *       F = C - iS.  Plane: rows 2l, 2l+1 too: (CC, CS; SC, SS), F(+,+) = CC - SS - i(CS + SC),
 *       F(+,-) = CC + SS + i(CS - SC).  Item b at b * stride_z; rows ld_z apart.
 *   w   (n_k, 2, n_cols): planes cos and sin, zero beyond the last step
 *   G   real and imaginary parts as rows, each unit's below the unit's before; item b owns the
 *       columns from b * n_cols:
 *
 *               0          n_cols       2 n_cols        ld
 *               +------------+------------+-- ... ------+
 *     unit 0    |   item 0   |   item 1   |             |    rows of a unit
 *               |            |            |             |      line   2k: re, im; k < h_x
 *               +------------+------------+-- ... ------+      plane  4k: re+, im+, re-, im-
 *     unit 1    |            |            |             |    a unit is a model row y (line) or a
 *               +------------+------------+-- ... ------+    row frequency l (plane)
 *
 *   Units run from `first` to first + n_units - 1, and G starts at the first.
 *   n_cols is a multiple of LANES, ld of 16.
 *   Launch: shift (n_cols / LANES, h_x, n_units * n_items), unshift (h_x, n_units * n_items); the
 *   first two axes, or the first, may be rounded up.
 *
 *   sum_chunks  pixels[b, p] = sum over chunks of part[chunk, l, b * n_cols + i]; 0 where
 *            not covered;
 *            launch (n_i rounded up, n_l, n_items); p = l * step_l + i * step_i
 *   scatter_pixels  part[l, b * n_cols + i] = pixels[b, p] where covered, else 0, the adjoint
 *            of one chunk;  launch (ld, n_l); columns without a pixel become 0
 *   pixels: image b from offset + b * stride on;  covered: of each pixel p, 1 or 0
 */
#include "common.h"

#ifndef LANES       /* columns of G that a work-item takes at a time: 4, 8 or 16 */
#define LANES 8
#endif

#define WIDE VEC(LANES)
#define READ(p) AT(const WIDE, p)
#define WRITE(p) AT(WIDE, p)
#define SUM4(v) (((v).s0 + (v).s1) + ((v).s2 + (v).s3))
#if LANES == 4
#define SUM(v) SUM4(v)
#elif LANES == 8
#define SUM(v) (SUM4((v).lo) + SUM4((v).hi))
#else
#define SUM(v) ((SUM4((v).lo.lo) + SUM4((v).lo.hi)) + (SUM4((v).hi.lo) + SUM4((v).hi.hi)))
#endif

__kernel void shift_line(const int h_x, const int n_units, const int first,
                         __global const REAL *restrict Z, const int stride_z, const int ld_z,
                         __global const REAL *restrict w_y, __global const REAL *restrict w_x,
                         __global REAL *restrict G, const int n_cols, const int ld)
{
    const int j = (int)get_global_id(0) * LANES, k = (int)get_global_id(1);
    const int unit = (int)get_global_id(2) % n_units, b = (int)get_global_id(2) / n_units;
    if (j >= n_cols || k >= h_x) return;
    Z += (size_t)b * stride_z + (size_t)(first + unit) * ld_z + 2 * k;
    w_x += (size_t)2 * k * n_cols + j;
    G += (size_t)2 * (unit * h_x + k) * ld + b * n_cols + j;
    const REAL c = Z[0], s = Z[1];
    const WIDE cx = READ(w_x), sx = READ(w_x + n_cols);
    WRITE(G) = c * cx + s * sx;
    WRITE(G + ld) = c * sx - s * cx;
}

__kernel void unshift_line(const int h_x, const int n_units, const int first,
                           __global REAL *restrict Z, const int stride_z, const int ld_z,
                           __global const REAL *restrict w_y, __global const REAL *restrict w_x,
                           __global const REAL *restrict G, const int n_cols, const int ld)
{
    const int k = (int)get_global_id(0);
    const int unit = (int)get_global_id(1) % n_units, b = (int)get_global_id(1) / n_units;
    if (k >= h_x) return;
    Z += (size_t)b * stride_z + (size_t)(first + unit) * ld_z + 2 * k;
    w_x += (size_t)2 * k * n_cols;
    G += (size_t)2 * (unit * h_x + k) * ld + b * n_cols;
    WIDE c = (WIDE)(0), s = (WIDE)(0);
    for (int j = 0; j < n_cols; j += LANES) {
        const WIDE cx = READ(w_x + j), sx = READ(w_x + n_cols + j);
        const WIDE re = READ(G + j), im = READ(G + ld + j);
        c += re * cx + im * sx;
        s += re * sx - im * cx;
    }
    Z[0] = SUM(c);
    Z[1] = SUM(s);
}

__kernel void shift_plane(const int h_x, const int n_units, const int first,
                          __global const REAL *restrict Z, const int stride_z, const int ld_z,
                          __global const REAL *restrict w_y, __global const REAL *restrict w_x,
                          __global REAL *restrict G, const int n_cols, const int ld)
{
    const int j = (int)get_global_id(0) * LANES, k = (int)get_global_id(1);
    const int unit = (int)get_global_id(2) % n_units, b = (int)get_global_id(2) / n_units;
    if (j >= n_cols || k >= h_x) return;
    Z += (size_t)b * stride_z + (size_t)2 * (first + unit) * ld_z + 2 * k;
    w_y += (size_t)2 * (first + unit) * n_cols + j;
    w_x += (size_t)2 * k * n_cols + j;
    G += (size_t)4 * (unit * h_x + k) * ld + b * n_cols + j;
    const REAL pr = Z[0] - Z[ld_z + 1], pi = -(Z[1] + Z[ld_z]);       /* F(+,+) */
    const REAL mr = Z[0] + Z[ld_z + 1], mi = Z[1] - Z[ld_z];          /* F(+,-) */
    const WIDE cy = READ(w_y), sy = READ(w_y + n_cols), cx = READ(w_x), sx = READ(w_x + n_cols);
    const WIDE cc = cy * cx, ss = sy * sx, sc = sy * cx, cs = cy * sx;
    WRITE(G) = pr * (cc - ss) - pi * (sc + cs);
    WRITE(G + ld) = pr * (sc + cs) + pi * (cc - ss);
    WRITE(G + (size_t)2 * ld) = mr * (cc + ss) - mi * (sc - cs);
    WRITE(G + (size_t)3 * ld) = mr * (sc - cs) + mi * (cc + ss);
}

__kernel void unshift_plane(const int h_x, const int n_units, const int first,
                            __global REAL *restrict Z, const int stride_z, const int ld_z,
                            __global const REAL *restrict w_y, __global const REAL *restrict w_x,
                            __global const REAL *restrict G, const int n_cols, const int ld)
{
    const int k = (int)get_global_id(0);
    const int unit = (int)get_global_id(1) % n_units, b = (int)get_global_id(1) / n_units;
    if (k >= h_x) return;
    Z += (size_t)b * stride_z + (size_t)2 * (first + unit) * ld_z + 2 * k;
    w_y += (size_t)2 * (first + unit) * n_cols;
    w_x += (size_t)2 * k * n_cols;
    G += (size_t)4 * (unit * h_x + k) * ld + b * n_cols;
    WIDE pr = (WIDE)(0), pi = (WIDE)(0), mr = (WIDE)(0), mi = (WIDE)(0);
    for (int j = 0; j < n_cols; j += LANES) {
        const WIDE cy = READ(w_y + j), sy = READ(w_y + n_cols + j);
        const WIDE cx = READ(w_x + j), sx = READ(w_x + n_cols + j);
        const WIDE cc = cy * cx, ss = sy * sx, sc = sy * cx, cs = cy * sx;
        const WIDE re_p = READ(G + j), im_p = READ(G + ld + j);
        const WIDE re_m = READ(G + (size_t)2 * ld + j), im_m = READ(G + (size_t)3 * ld + j);
        pr += re_p * (cc - ss) + im_p * (sc + cs);
        pi += im_p * (cc - ss) - re_p * (sc + cs);
        mr += re_m * (cc + ss) + im_m * (sc - cs);
        mi += im_m * (cc + ss) - re_m * (sc - cs);
    }
    const REAL a = SUM(pr), b_ = SUM(pi), c = SUM(mr), d = SUM(mi);
    Z[0] = a + c;
    Z[1] = d - b_;
    Z[ld_z] = -(b_ + d);
    Z[ld_z + 1] = c - a;
}

__kernel void sum_chunks(const int n_chunks, const int n_i, const int n_cols, const int ld,
                      __global const REAL *restrict part, __global const uchar *restrict covered,
                      __global REAL *restrict pixels, const ulong offset, const int stride,
                      const int step_l, const int step_i)
{
    const int i = (int)get_global_id(0), l = (int)get_global_id(1), b = (int)get_global_id(2);
    const size_t step = (size_t)get_global_size(1) * ld;
    if (i >= n_i) return;
    const size_t p = (size_t)l * step_l + (size_t)i * step_i;
    part += (size_t)l * ld + (size_t)b * n_cols + i;
    REAL sum = 0;
    for (int chunk = 0; chunk < n_chunks; ++chunk) sum += part[chunk * step];
    pixels[offset + (size_t)b * stride + p] = covered[p] ? sum : (REAL)0;
}

__kernel void scatter_pixels(const int n_items, const int n_i, const int n_cols, const int ld,
                     __global REAL *restrict part, __global const uchar *restrict covered,
                     __global const REAL *restrict pixels, const ulong offset, const int stride,
                     const int step_l, const int step_i)
{
    const int j = (int)get_global_id(0), l = (int)get_global_id(1);
    if (j >= ld) return;
    const int b = j / n_cols, i = j % n_cols;
    const size_t p = (size_t)l * step_l + (size_t)i * step_i;
    REAL value = 0;
    if (b < n_items && i < n_i && covered[p]) value = pixels[offset + (size_t)b * stride + p];
    part[(size_t)l * ld + j] = value;
}
