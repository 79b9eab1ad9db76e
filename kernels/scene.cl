/* A batch of scenes: models from sources, residuals from models, gradients from residuals.
 *
 * Sources are sorted by scene; those of scene b are first[b] .. first[b + 1] - 1.
 *   morph, d_morph, table: morphologies, their gradients and their boxes, see boxes.h; boxes lie
 *             inside the frame
 *   spectra   (S, C): all channels of all observations; an observation has n_bands from `channel`
 *   model     (B, n_bands, ny_frame, nx_frame), image, data, weights (B, n_bands, my, mx)
 *   sky       (B, C)
 *
 * compose     model[b, c, y, x] = sum_s spectra[s, channel + c] S_s[y - y0, x - x0]
 *             launch: (X, ny_frame, B * n_bands)
 * residual    r = image + sky - data, image <- w r, loss[b, row] = 1/2 sum_x w r^2,
 *             pull[b, row] = sum_x w r;  row = c * my + y of this observation, from `row0` on
 *             launch: (my, n_bands, B): one work-item a row, which writes that row's sums
 * square      image <- image^2;  launch: as residual
 * gather_morph    dS_s[y, x] (+)= sum_c spectra[s, channel + c] G[b, c, y0 + y, x0 + x]
 *             for the sources listed in `active`; launch: (X, tallest box, len(active))
 * gather_spectra  dA[s, channel + c] = sum_yx S_s[y, x] G[b, c, y0 + y, x0 + x]
 *             launch: (WG, n_bands, S), groups of (WG, 1, 1)
 *
 * X is 1 where a work-item walks a whole row (ROWS of group.h), else the width of the widest row.
 */
#include "common.h"
#include "boxes.h"
#include "group.h"

#define HEAD(s) \
    __global const int *box = BOX(s); \
    const int y0 = box[Y0], x0 = box[X0], ny = box[NY], nx = box[NX]; \
    const size_t offset = BEGIN(box);

__kernel void compose(__global const int *restrict first, __global const int *restrict table,
                      __global const REAL *restrict morph,
                      __global const REAL *restrict spectra, const int n_channels,
                      const int channel, const int n_bands, const int ny_frame, const int nx_frame,
                      __global REAL *restrict model)
{
    const int y = (int)get_global_id(1), c = (int)get_global_id(2) % n_bands;
    const int b = (int)get_global_id(2) / n_bands;
    __global REAL *row = model + (((size_t)b * n_bands + c) * ny_frame + y) * nx_frame;
    FOR_X(x, nx_frame) row[x] = 0;
    for (int s = first[b]; s < first[b + 1]; ++s) {
        HEAD(s)
        if (y < y0 || y >= y0 + ny) continue;
        const REAL a = spectra[(size_t)s * n_channels + channel + c];
        __global const REAL *m = morph + offset + (size_t)(y - y0) * nx;
#if ROWS
        for (int x = 0; x < nx; ++x) row[x0 + x] += a * m[x];
#else
        FOR_X(x, nx_frame)
            if (x >= x0 && x < x0 + nx) row[x] += a * m[x - x0];
#endif
    }
}

__kernel void residual(const int n_channels, const int channel, const int n_bands, const int my,
                       const int mx, const int row0, const int n_rows,
                       __global const REAL *restrict data, __global const REAL *restrict weights,
                       __global const REAL *restrict sky, __global REAL *restrict image,
                       __global REAL *restrict loss, __global REAL *restrict pull)
{
    const int y = (int)get_global_id(0), c = (int)get_global_id(1), b = (int)get_global_id(2);
    const size_t i = (((size_t)b * n_bands + c) * my + y) * mx;
    const REAL level = sky[(size_t)b * n_channels + channel + c];
    REAL chi2[8] = {0, 0, 0, 0, 0, 0, 0, 0}, sum[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    for (int x0 = 0; x0 < mx; x0 += 8)
        for (int k = 0; k < 8; ++k) {
            const int x = x0 + k;
            if (x < mx) {
                const REAL r = image[i + x] + level - data[i + x], wr = weights[i + x] * r;
                image[i + x] = wr;
                chi2[k] += wr * r;
                sum[k] += wr;
            }
        }
    REAL total = 0, total_pull = 0;
    for (int k = 0; k < 8; ++k) {
        total += chi2[k];
        total_pull += sum[k];
    }
    const size_t row = (size_t)b * n_rows + row0 + c * my + y;
    loss[row] = (REAL)0.5 * total;
    pull[row] = total_pull;
}

__kernel void square(const int n_bands, const int my, const int mx, __global REAL *restrict image)
{
    const int y = (int)get_global_id(0), c = (int)get_global_id(1), b = (int)get_global_id(2);
    __global REAL *row = image + (((size_t)b * n_bands + c) * my + y) * mx;
    for (int x = 0; x < mx; ++x) row[x] *= row[x];
}

__kernel void gather_morph(__global const int *restrict active, __global const int *restrict table,
                           __global const REAL *restrict gradient,
                           __global const REAL *restrict spectra, const int n_channels,
                           const int channel, const int n_bands, const int ny_frame,
                           const int nx_frame, const int add, __global REAL *restrict d_morph)
{
    const int s = active[get_global_id(2)], y = (int)get_global_id(1);
    HEAD(s)
    if (y >= ny) return;
    const int b = box[SCENE];
    __global REAL *out = d_morph + offset + (size_t)y * nx;
    if (!add) FOR_X(x, nx) out[x] = 0;
    for (int c = 0; c < n_bands; ++c) {
        const REAL a = spectra[(size_t)s * n_channels + channel + c];
        __global const REAL *g =
            gradient + (((size_t)b * n_bands + c) * ny_frame + y0 + y) * nx_frame + x0;
        FOR_X(x, nx) out[x] += a * g[x];
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void gather_spectra(__global const int *restrict table, __global const REAL *restrict gradient,
                    __global const REAL *restrict morph, const int n_channels, const int channel,
                    const int n_bands, const int ny_frame, const int nx_frame,
                    __global REAL *restrict d_spectra)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), c = (int)get_global_id(1), s = (int)get_global_id(2);
    HEAD(s)
    const int b = box[SCENE];
    __global const REAL *g =
        gradient + (((size_t)b * n_bands + c) * ny_frame + y0) * nx_frame + x0;
    REAL total = 0;
    for (int y = lid; y < ny; y += WG) {
        __global const REAL *m = morph + offset + (size_t)y * nx;
        REAL part[8] = {0, 0, 0, 0, 0, 0, 0, 0};
        int x = 0;
        for (; x + 8 <= nx; x += 8)
            for (int k = 0; k < 8; ++k) part[k] += m[x + k] * g[(size_t)y * nx_frame + x + k];
        for (; x < nx; ++x) part[0] += m[x] * g[(size_t)y * nx_frame + x];
        total += SUM8(part);
    }
    total = group_sum(total, lid, share);
    if (lid == 0) d_spectra[(size_t)s * n_channels + channel + c] = total;
}
