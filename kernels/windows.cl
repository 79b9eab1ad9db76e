/* Adds rendered windows of source groups to observed images; cuts windows out of images.
 *
 *   image     (B, n_bands, my, mx); windows (G, n_bands, wy, wx); window g covers the
 *             pixels from low[g] (y, x) on, in part or all of them outside of the image
 *   Groups are sorted by scene; those of scene b are first[b] .. first[b + 1] - 1.
 *
 * add_windows  image[b, c, y, x] (+)= sum_g windows[g, c, y - low_y, x - low_x]
 *           launch: (X, my, B * n_bands)
 * cut_windows       windows[g, c, y, x] = image[scene[g], c, y + low_y, x + low_x], 0 outside of it
 *           launch: (X, wy, G * n_bands)
 *
 * X is 1 where a work-item walks a whole row (ROWS of work_group.h), else at least a row's pixels.
 */
#include "common.h"
#include "work_group.h"

__kernel void add_windows(__global const int *restrict first, __global const int *restrict low,
                       const int n_bands, const int my, const int mx, const int wy, const int wx,
                       const int add, __global const REAL *restrict windows,
                       __global REAL *restrict image)
{
    const int c = (int)get_global_id(2) % n_bands, b = (int)get_global_id(2) / n_bands;
    FOR_Y(y, my) {
        __global REAL *row = image + (((size_t)b * n_bands + c) * my + y) * mx;
#if ROWS
        if (!add)
            for (int x = 0; x < mx; ++x) row[x] = 0;
        for (int g = first[b]; g < first[b + 1]; ++g) {
            const int v = y - low[2 * g], left = low[2 * g + 1];
            if (v < 0 || v >= wy) continue;
            __global const REAL *w = windows + (((size_t)g * n_bands + c) * wy + v) * wx;
            const int begin = left > 0 ? 0 : -left, end = mx - left < wx ? mx - left : wx;
            for (int u = begin; u < end; ++u) row[left + u] += w[u];
        }
#else
        FOR_X(x, mx) {
            REAL sum = add ? row[x] : (REAL)0;
            for (int g = first[b]; g < first[b + 1]; ++g) {
                const int v = y - low[2 * g], u = x - low[2 * g + 1];
                if (v >= 0 && v < wy && u >= 0 && u < wx)
                    sum += windows[(((size_t)g * n_bands + c) * wy + v) * wx + u];
            }
            row[x] = sum;
        }
#endif
    }
}

__kernel void cut_windows(__global const int *restrict scene, __global const int *restrict low,
                  const int n_bands, const int my, const int mx, const int wy, const int wx,
                  __global const REAL *restrict image, __global REAL *restrict windows)
{
    const int c = (int)get_global_id(2) % n_bands, g = (int)get_global_id(2) / n_bands;
    const int left = low[2 * g + 1];
    FOR_Y(v, wy) {
        const int y = v + low[2 * g];
        __global REAL *w = windows + (((size_t)g * n_bands + c) * wy + v) * wx;
        const int inside = y >= 0 && y < my;
        __global const REAL *row =
            image + (((size_t)scene[g] * n_bands + c) * my + (inside ? y : 0)) * mx;
        FOR_X(u, wx) {
            const int x = left + u;
            w[u] = inside && x >= 0 && x < mx ? row[x] : (REAL)0;
        }
    }
}
