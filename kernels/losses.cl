/* The losses of a batch of scenes, and the best state of each so far.
 *
 * losses      out[i_loss, b] = sum of loss rows + 1/2 sum_s |z_s|^2, z the flat `latent`
 *             best[b] = the lowest of those with i_loss = 0; launch: (WG, B), groups of (WG, 1)
 * keep_best  kept_* <- latent, morph, spectra, sky of the scenes whose loss[b] is best[b], and so
 *             never of one whose loss is NaN; launch: (X, tallest box, S)
 * expect_sky  first row r of each channel c: rows[b, r] += 1/2 precision[b, c] sky[b, c]^2 and
 *             pull[b, r] += precision[b, c] sky[b, c], for n = B C levels; launch: see FOR_I
 *
 * rows (B, n_rows): losses of the observed rows; spectra (S, C), sky (B, C)
 * first, table, X, flat buffers: as in scene.cl
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void losses(__global const int *restrict first, __global const int *restrict table,
            const int n_rows, __global const REAL *restrict rows, const int prior,
            __global const REAL *restrict latent, __global REAL *restrict out,
            __global REAL *restrict best, const int i_loss)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), b = (int)get_global_id(1);
    REAL total = 0;
    for (int r = lid; r < n_rows; r += WG) total += rows[(size_t)b * n_rows + r];
    if (prior)
        for (int s = first[b]; s < first[b + 1]; ++s) {
            __global const int *box = BOX(s);
            __global const REAL *z = latent + BEGIN(box);
            const int n = box[NY] * box[NX];
#if ROWS
            REAL part[8] = {0, 0, 0, 0, 0, 0, 0, 0};
            int i = 0;
            for (; i + 8 <= n; i += 8)
                for (int k = 0; k < 8; ++k) part[k] += z[i + k] * z[i + k];
            for (; i < n; ++i) part[0] += z[i] * z[i];
            total += (REAL)0.5 * SUM8(part);
#else
            for (int i = lid; i < n; i += WG) total += (REAL)0.5 * z[i] * z[i];
#endif
        }
    total = group_sum(total, lid, share);
    if (lid > 0) return;
    out[(size_t)i_loss * get_global_size(1) + b] = total;
    if (i_loss == 0 && total < best[b]) best[b] = total;
}

__kernel void keep_best(__global const int *restrict active, __global const int *restrict table,
                   __global const int *restrict first, const int n_channels,
                   __global const REAL *restrict loss, __global const REAL *restrict best,
                   __global const REAL *restrict latent, __global const REAL *restrict morph,
                   __global const REAL *restrict spectra, __global const REAL *restrict sky,
                   __global REAL *restrict kept_latent, __global REAL *restrict kept_morph,
                   __global REAL *restrict kept_spectra, __global REAL *restrict kept_sky)
{
    const int s = active[get_global_id(2)];
    __global const int *box = BOX(s);
    const int b = box[SCENE], nx = box[NX];
    if (!(loss[b] == best[b])) return;
    FOR_Y(y, box[NY]) {
        const size_t row = BEGIN(box) + (size_t)y * nx;
        FOR_X(x, nx) kept_latent[row + x] = latent[row + x];
        FOR_X(x, nx) kept_morph[row + x] = morph[row + x];
    }
    if (get_global_id(1) > 0 || get_global_id(0) > 0) return;
    for (int c = 0; c < n_channels; ++c) {
        const size_t i = (size_t)s * n_channels + c, j = (size_t)b * n_channels + c;
        kept_spectra[i] = spectra[i];
        if (s == first[b]) kept_sky[j] = sky[j];
    }
}

__kernel void expect_sky(const int n, const int n_channels, const int n_rows,
                         __global const int *restrict row0, __global const REAL *restrict precision,
                         __global const REAL *restrict sky, __global REAL *restrict rows,
                         __global REAL *restrict pull)
{
    FOR_I(i, n) {
        const size_t r = (size_t)(i / n_channels) * n_rows + row0[i % n_channels];
        const REAL slope = precision[i] * sky[i];
        rows[r] += (REAL)0.5 * slope * sky[i];
        pull[r] += slope;
    }
}
