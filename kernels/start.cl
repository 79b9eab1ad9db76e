/* The start of a fit: products of profiles, rendered in windows, with each other and with the data.
 *
 * A slot is one component of one scene, with n images drawn by draw.cl: its profile and,
 * optionally, the slopes of the profile by its parameters.
 *
 *         model frame                      one channel of an observation
 *         +-----------------+              +------------------+
 *         |   +-----+       |              |  +----------+    |   window (wy, wx) from (y0, x0) on,
 *         |   | box |       |      R       |  |          |    |   all that the box's light reaches;
 *         |   +-----+       |     --->     |  +----------+    |   may lie in part beyond the pixels
 *         +-----------------+              +------------------+
 *
 *   place    (slots, N_PLACE) int: scene, y0, x0, wy, wx, n, and the element of `images` where the
 *            slot's images begin: (n, n_bands, wy, wx), row by row
 *   root, data, light, residual, weight   (B, n_bands, my, mx): root of the weights, data, smoothed
 *            data times root
 *
 * whiten   images <- images root;  launch: (X, tallest window, slots)
 * compute_residuals  model m = sky root + sum_slots A images, residual r = data root - m, weight
 *          w = 1 / (1 + (error (light - sky root))^2) where root is not 0, error (B, n_bands);
 *          sums (B, n_bands, 3, my): of w r^2, w r root, w root^2;
 *          launch: (WG my, n_bands, scenes), a group a row.  `listed`: the slots scene by scene,
 *          those of scenes[k] from first[k] to first[k + 1]
 * gram     out (pairs, n_bands, K, K) = sum over the pixels where both windows lie of w a_i b_j;
 *          pairs (., 6) int: slots a, b, and the pixels: y, x, height, width; images beyond a
 *          slot's n repeat its last;  launch: (WG pairs, n_bands), groups of (WG, 1): pairs are on
 *          the first axis because GPUs limit the groups along other axes
 * residual_products     out (slots, n_bands, K, 2) = sums of w a_i r and w a_i root;
 *          launch: (WG slots, n_bands)
 *
 * X is 1 where a work-item walks a whole row (ROWS of work_group.h), else the width of the widest
 *     row.
 */
#include "common.h"
#include "work_group.h"
#ifndef K           /* images of a slot: 1, or 5 with slopes */
#define K 1
#endif
#ifndef PER_ROOT    /* 1: residual_products sums w a_i / root in place of w a_i root */
#define PER_ROOT 0
#endif
#if PER_ROOT
#define WITH_ROOT(wa, root) ((root) > 0 ? (wa) / (root) : 0)
#else
#define WITH_ROOT(wa, root) ((wa) * (root))
#endif

enum { SCENE, Y0, X0, WY, WX, N_IMAGES, BEGIN, N_PLACE };
__kernel void whiten(__global const int *restrict place, const int n_bands, const int my,
                     const int mx, __global const REAL *restrict root,
        __global REAL *restrict images)
{
    const int s = (int)get_global_id(2), y = (int)get_global_id(1);
    __global const int *p = place + N_PLACE * (size_t)s;
    const int wy = p[WY], wx = p[WX], y0 = p[Y0], x0 = p[X0], n = p[N_IMAGES];
    if (y >= wy) return;
    __global REAL *image = images + p[BEGIN] + (size_t)y * wx;
    const int inside = y0 + y >= 0 && y0 + y < my;
    const int low = x0 < 0 ? -x0 : 0, high = x0 + wx < mx ? wx : mx - x0;
    for (int k = 0; k < n; ++k)
        for (int c = 0; c < n_bands; ++c) {
            __global REAL *row = image + ((size_t)k * n_bands + c) * wy * wx;
            if (inside) {
                __global const REAL *r =
                    root + (((size_t)p[SCENE] * n_bands + c) * my + y0 + y) * mx + x0;
                FOR_X(x, wx) row[x] = x >= low && x < high ? row[x] * r[x] : 0;
            } else {
                FOR_X(x, wx) row[x] = 0;
            }
        }
}

/* For slot s in row y of channel c: the window's columns wx from x0 on, its flux a, and its image's
 * row u; continues with the next slot if it has no light there. */
#define SLOT(s) \
    __global const int *p = place + N_PLACE * (size_t)(s); \
    const int wy = p[WY], wx = p[WX], row = y - p[Y0], x0 = p[X0]; \
    if (row < 0 || row >= wy) continue; \
    const REAL a = spectra[(size_t)(s) * n_channels + channel + c]; \
    if (a == 0) continue; \
    __global const REAL *u = images + p[BEGIN] + ((size_t)c * wy + row) * wx;

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void compute_residuals(__global const int *restrict scenes, __global const int *restrict first,
             __global const int *restrict listed, __global const int *restrict place,
             const int n_bands, const int my, const int mx, const int channel,
             const int n_channels, __global const REAL *restrict error,
             __global const REAL *restrict spectra,
             __global const REAL *restrict sky, __global const REAL *restrict root,
             __global const REAL *restrict data, __global const REAL *restrict light,
             __global const REAL *restrict images, __global REAL *restrict residual,
             __global REAL *restrict weight,
             __global REAL *restrict sums)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), y = (int)get_group_id(0);
    const int c = (int)get_global_id(1), k = (int)get_global_id(2), b = scenes[k];
    const size_t line = ((size_t)b * n_bands + c) * my + y;
    __global REAL *m = residual + line * mx, *w = weight + line * mx;
    __global const REAL *r = root + line * mx, *d = data + line * mx;
    __global const REAL *bright = light + line * mx;
    const REAL part_of_light = error[(size_t)b * n_bands + c];
    const REAL level = sky[(size_t)b * n_channels + channel + c];
#if ROWS
    for (int x = 0; x < mx; ++x) m[x] = level * r[x];
    for (int l = first[k]; l < first[k + 1]; ++l) {
        SLOT(listed[l])
        const int low = x0 < 0 ? -x0 : 0, high = x0 + wx < mx ? wx : mx - x0;
        for (int x = low; x < high; ++x) m[x0 + x] += a * u[x];
    }
#else
    for (int x = lid; x < mx; x += WG) {
        REAL sum = level * r[x];
        for (int l = first[k]; l < first[k + 1]; ++l) {
            SLOT(listed[l])
            if (x >= x0 && x < x0 + wx) sum += a * u[x - x0];
        }
        m[x] = sum;
    }
#endif
    REAL chi2[8] = {0, 0, 0, 0, 0, 0, 0, 0}, by_sky[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    REAL of_sky[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    for (int at = ROWS ? 0 : lid; at < mx; at += ROWS ? 8 : 8 * WG)
        for (int i = 0; i < 8; ++i) {
            const int x = ROWS ? at + i : at + i * WG;
            if (x < mx) {
                const REAL part = part_of_light * (bright[x] - level * r[x]);
                const REAL rest = d[x] * r[x] - m[x], weigh = 1 / (1 + part * part);
                m[x] = rest;
                w[x] = weigh;
                chi2[i] += weigh * rest * rest;
                by_sky[i] += weigh * rest * r[x];
                of_sky[i] += weigh * r[x] * r[x];
            }
        }
    const REAL a = group_sum(SUM8(chi2), lid, share), e = group_sum(SUM8(by_sky), lid, share);
    const REAL o = group_sum(SUM8(of_sky), lid, share);
    if (lid == 0) {
        __global REAL *sum = sums + 3 * (line - y) + y;
        sum[0] = a;
        sum[my] = e;
        sum[2 * my] = o;
    }
}

/* Image i of a slot in channel c, at a pixel of the observation; the last one beyond n. */
#define ROW_OF(p, i) \
    (images + (p)[BEGIN] + \
     (((size_t)((i) < (p)[N_IMAGES] ? (i) : (p)[N_IMAGES] - 1) * n_bands + c) * (p)[WY] \
      + y0 + y - (p)[Y0]) * (p)[WX] + x0 - (p)[X0])

/* The operation for each image j of the other slot, without an array of arrays, which compilers for
 * CPUs would keep in memory instead of registers. */
#if K > 1
#define EACH(DO) DO(0) DO(1) DO(2) DO(3) DO(4)
#else
#define EACH(DO) DO(0)
#endif
#define ZERO(j) REAL sum##j[8] = {0, 0, 0, 0, 0, 0, 0, 0};
#define OTHER(j) __global const REAL *b##j = ROW_OF(q, j);
#define MULTIPLY(j) for (int k = 0; k < 8; ++k) sum##j[k] += left[k] * b##j[x + k];
#define MULTIPLY_ONE(j) sum##j[0] += one * b##j[x];
#define TOTAL(j) total[i][j] = SUM8(sum##j);

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void gram(__global const int *restrict pairs, __global const int *restrict place,
          const int n_bands, const int my, const int mx, __global const REAL *restrict images,
          __global const REAL *restrict weight, __global REAL *restrict out)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), c = (int)get_global_id(1);
    const size_t pair = get_group_id(0);
    __global const int *t = pairs + 6 * pair;
    __global const int *p = place + N_PLACE * (size_t)t[0], *q = place + N_PLACE * (size_t)t[1];
    const int y0 = t[2], x0 = t[3], height = t[4], width = t[5];
    REAL total[K][K];
    for (int i = 0; i < K; ++i) {       /* a row of the result at a time, in registers */
        EACH(ZERO)
        for (int y = lid; y < height; y += WG) {
            __global const REAL *w =
                weight + (((size_t)p[SCENE] * n_bands + c) * my + y0 + y) * mx + x0;
            __global const REAL *a = ROW_OF(p, i);
            EACH(OTHER)
            int x = 0;
            for (; x + 8 <= width; x += 8) {
                REAL left[8];
                for (int k = 0; k < 8; ++k) left[k] = a[x + k] * w[x + k];
                EACH(MULTIPLY)
            }
            for (; x < width; ++x) {
                const REAL one = a[x] * w[x];
                EACH(MULTIPLY_ONE)
            }
        }
        EACH(TOTAL)
    }
    for (int i = 0; i < K; ++i)
        for (int j = 0; j < K; ++j) {
            const REAL all = group_sum(total[i][j], lid, share);
            if (lid == 0) out[((pair * n_bands + c) * K + i) * K + j] = all;
        }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void residual_products(__global const int *restrict place, const int n_bands, const int my,
        const int mx,
          __global const REAL *restrict images, __global const REAL *restrict weight,
          __global const REAL *restrict residual, __global const REAL *restrict root,
          __global REAL *restrict out)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), c = (int)get_global_id(1);
    const size_t s = get_group_id(0);
    __global const int *p = place + N_PLACE * s;
    const int y0 = p[Y0] > 0 ? p[Y0] : 0, x0 = p[X0] > 0 ? p[X0] : 0;
    const int y1 = p[Y0] + p[WY] < my ? p[Y0] + p[WY] : my;
    const int x1 = p[X0] + p[WX] < mx ? p[X0] + p[WX] : mx;
    REAL by_data[K], by_root[K];
    for (int i = 0; i < K; ++i) by_data[i] = by_root[i] = 0;
    for (int y = lid; y < y1 - y0; y += WG) {
        const size_t line = (((size_t)p[SCENE] * n_bands + c) * my + y0 + y) * mx + x0;
        for (int i = 0; i < K; ++i) {
            __global const REAL *a = ROW_OF(p, i);
            REAL one[8] = {0, 0, 0, 0, 0, 0, 0, 0}, other[8] = {0, 0, 0, 0, 0, 0, 0, 0};
            int x = 0;
            for (; x + 8 <= x1 - x0; x += 8)
                for (int k = 0; k < 8; ++k) {
                    const REAL wa = weight[line + x + k] * a[x + k];
                    one[k] += wa * residual[line + x + k];
                    other[k] += WITH_ROOT(wa, root[line + x + k]);
                }
            for (; x < x1 - x0; ++x) {
                const REAL wa = weight[line + x] * a[x];
                one[0] += wa * residual[line + x];
                other[0] += WITH_ROOT(wa, root[line + x]);
            }
            by_data[i] += SUM8(one);
            by_root[i] += SUM8(other);
        }
    }
    for (int i = 0; i < K; ++i) {
        const REAL d = group_sum(by_data[i], lid, share), r = group_sum(by_root[i], lid, share);
        if (lid == 0) {
            out[2 * ((s * n_bands + c) * K + i)] = d;
            out[2 * ((s * n_bands + c) * K + i) + 1] = r;
        }
    }
}
