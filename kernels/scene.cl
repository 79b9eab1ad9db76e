/* A batch of scenes: model frames, residuals, loss, gradients by morphology and spectrum.
 *
 * The sources of scene b are order[first[b]] .. order[first[b + 1] - 1].  Each has an image in a
 * box of its scene's frame.  The image is a morphology, or a morphology transformed along one or
 * both axes; then the box is as wide as the frame, or is the whole frame:
 *   boxed, d_boxed, table: images, their gradients and their boxes, see boxes.h; boxes lie inside
 *             the frame
 *   spectra   (S, C): all channels of all observations; an observation has n_bands from `channel`
 *   frame     (B, n_bands, ny_frame, nx_frame), image, data, weights (B, n_bands, my, mx)
 *   sky       (B, C)
 *
 * compose     frame[b, c, y, x] = sum_s spectra[s, channel + c] boxed_s[y - y0, x - x0]
 *             launch: (X, ny_frame, B * n_bands)
 * compose_frequencies  the same for images with both axes transformed, times the transfer functions
 *             E (B or 1, n_bands, ny_frame / 2, 4, nx_frame / 2), see MIX of contract.cl; stride_e:
 *             elements between scenes.  The boxes are the first rows and columns of the frame,
 *             equal for all sources of a scene; the rest of its frame is not written.
 *             launch: (vectors of VW columns of a row, or 1 with ROWS, ny_frame / 2, B * n_bands)
 *             VW divides nx_frame
 * residual    r = image + sky - data, image <- w r, loss[b, row] = 1/2 sum_x w r^2,
 *             pull[b, row] = sum_x w r;  row = c * my + y of this observation, from `row0` on
 *             launch: (WG, my, B * n_bands), groups of (WG, 1, 1), which share a row
 * square      image <- image^2;  launch: (X, my, B * n_bands)
 * gather_morph    d_boxed_s[y, x] (+)= sum_c spectra[s, channel + c] frame[b, c, y0 + y, x0 + x]
 *             for the sources listed in `active`; launch: (X, any, len(active))
 * gather_spectra  dA[s, channel + c] = sum_yx boxed_s[y, x] frame[b, c, y0 + y, x0 + x]
 *             for the sources listed in `active`
 *             launch: (WG, n_bands, len(active)), groups of (WG, 1, 1)
 * split_spectra       parts[s, c, t] = spectra[s, channel + c] shares[s, c, t], both (S, n_bands,
 *             n_terms): a source's spectrum in each term of its PSF;  launch: (X, S, 1), rows
 *             of n_bands
 * merge_spectra  spectra[s, channel + c] = sum_t shares[s, c, t] parts[s, c, t];  launch: the same
 *
 * X is 1 where a work-item walks a whole row (ROWS of work_group.h), else the width of a row or any
 * other, since work-items stride over a row; of the second axis, which counts rows, any part or
 * more than all may be launched.
 */
#include "contract.h"
#include "boxes.h"
#include "work_group.h"
#define LANES 16    /* parallel sums if a work-item has a whole row */

#define HEAD(s) \
    __global const int *box = BOX(s); \
    const int y0 = box[Y0], x0 = box[X0], ny = box[NY], nx = box[NX]; \
    const size_t offset = BEGIN(box);
#define ROW_OF(array, b, c, n_c, y, n_y, n_x) \
    (array + ((((size_t)(b) * (n_c) + (c)) * (n_y)) + (y)) * (n_x))

__kernel void compose(__global const int *restrict first, __global const int *restrict order,
                      __global const int *restrict table, __global const REAL *restrict boxed,
                      __global const REAL *restrict spectra, const int n_channels,
                      const int channel, const int n_bands, const int ny_frame, const int nx_frame,
                      __global REAL *restrict frame)
{
    const int c = (int)get_global_id(2) % n_bands, b = (int)get_global_id(2) / n_bands;
    FOR_Y(y, ny_frame) {
        __global REAL *row = ROW_OF(frame, b, c, n_bands, y, ny_frame, nx_frame);
#if ROWS
        for (int x = 0; x < nx_frame; ++x) row[x] = 0;
        for (int i = first[b]; i < first[b + 1]; ++i) {
            const int s = order[i];
            HEAD(s)
            if (y < y0 || y >= y0 + ny) continue;
            const REAL a = spectra[(size_t)s * n_channels + channel + c];
            __global const REAL *m = boxed + offset + (size_t)(y - y0) * nx;
            for (int x = 0; x < nx; ++x) row[x0 + x] += a * m[x];
        }
#else
        FOR_X(x, nx_frame) {
            REAL sum = 0;
            for (int i = first[b]; i < first[b + 1]; ++i) {
                const int s = order[i];
                HEAD(s)
                if (y >= y0 && y < y0 + ny && x >= x0 && x < x0 + nx)
                    sum += spectra[(size_t)s * n_channels + channel + c]
                         * boxed[offset + (size_t)(y - y0) * nx + (x - x0)];
            }
            row[x] = sum;
        }
#endif
    }
}

__kernel void compose_frequencies(
    __global const int *restrict first, __global const int *restrict order,
    __global const int *restrict table,
    __global const REAL *restrict boxed, __global const REAL *restrict spectra,
    const int n_channels, const int channel, const int n_bands, const int ny_frame,
    const int nx_frame, __global const REAL *restrict E, const int stride_e,
    __global REAL *restrict frame)
{
    const int c = (int)get_global_id(2) % n_bands, b = (int)get_global_id(2) / n_bands;
    if (first[b] == first[b + 1]) return;
    __global const int *box = BOX(order[first[b]]);
    const int nx = box[NX], n_rows = box[NY] / 2;
    FOR_Y(h, n_rows) {
        __global REAL *row = ROW_OF(frame, b, c, n_bands, 2 * h, ny_frame, nx_frame);
        __global const REAL *e =
            E + (size_t)b * stride_e + (size_t)c * ny_frame * nx_frame + (size_t)h * 2 * nx_frame;
        FOR_X(v, nx / VW) {
            const int x = v * VW;
            WIDE cos_y = (WIDE)(0), sin_y = (WIDE)(0);
            for (int i = first[b]; i < first[b + 1]; ++i) {
                const int s = order[i];
                const REAL a = spectra[(size_t)s * n_channels + channel + c];
                __global const REAL *u = boxed + BEGIN(BOX(s)) + (size_t)2 * h * nx + x;
                cos_y += a * AT(const WIDE, u);
                sin_y += a * AT(const WIDE, u + nx);
            }
            __global const REAL *d = e + x / 2;
            const HALF pr = AT(const HALF, d), pi = AT(const HALF, d + nx_frame / 2);
            const HALF mr = AT(const HALF, d + nx_frame), mi = AT(const HALF, d + nx_frame / 2 * 3);
            TIMES_TRANSFER(HALF, pr, pi, mr, mi, EVEN(cos_y), ODD(cos_y), EVEN(sin_y), ODD(sin_y),
                           EVEN(cos_y), ODD(cos_y), EVEN(sin_y), ODD(sin_y))
            AT(WIDE, row + x) = cos_y;
            AT(WIDE, row + nx_frame + x) = sin_y;
        }
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void residual(const int n_channels, const int channel, const int n_bands, const int my,
              const int mx, const int row0, const int n_rows,
              __global const REAL *restrict data, __global const REAL *restrict weights,
              __global const REAL *restrict sky, __global REAL *restrict image,
              __global REAL *restrict loss, __global REAL *restrict pull)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0);
    const int c = (int)get_global_id(2) % n_bands, b = (int)get_global_id(2) / n_bands;
    const REAL level = sky[(size_t)b * n_channels + channel + c];
    FOR_Y(y, my) {
        const size_t at = (((size_t)b * n_bands + c) * my + y) * mx;
        __global const REAL *d = data + at, *w = weights + at;
        __global REAL *row = image + at;
        REAL total = 0, total_pull = 0;
        int x = lid;
#if ROWS
        REAL chi2[LANES], sum[LANES];
        for (int l = 0; l < LANES; ++l) chi2[l] = sum[l] = 0;
        for (x = 0; x + LANES <= mx; x += LANES)
            for (int l = 0; l < LANES; ++l) {
                const REAL r = row[x + l] + level - d[x + l], wr = w[x + l] * r;
                row[x + l] = wr;
                chi2[l] += wr * r;
                sum[l] += wr;
            }
        total = SUM8(chi2) + SUM8(chi2 + 8);
        total_pull = SUM8(sum) + SUM8(sum + 8);
#endif
        for (; x < mx; x += WG) {
            const REAL r = row[x] + level - d[x], wr = w[x] * r;
            row[x] = wr;
            total += wr * r;
            total_pull += wr;
        }
        total = group_sum(total, lid, share);
        total_pull = group_sum(total_pull, lid, share);
        if (lid == 0) {
            const size_t i = (size_t)b * n_rows + row0 + c * my + y;
            loss[i] = (REAL)0.5 * total;
            pull[i] = total_pull;
        }
    }
}

__kernel void square(const int my, const int mx, __global REAL *restrict image)
{
    FOR_Y(y, my) {
        __global REAL *row = image + ((size_t)get_global_id(2) * my + y) * mx;
        FOR_X(x, mx) row[x] *= row[x];
    }
}

__kernel void gather_morph(__global const int *restrict active, __global const int *restrict table,
                           __global const REAL *restrict frame,
                           __global const REAL *restrict spectra, const int n_channels,
                           const int channel, const int n_bands, const int ny_frame,
                           const int nx_frame, const int add, __global REAL *restrict d_boxed)
{
    const int s = active[get_global_id(2)];
    HEAD(s)
    __global const REAL *a = spectra + (size_t)s * n_channels + channel;
    const size_t band = (size_t)ny_frame * nx_frame;
    FOR_Y(y, ny) {
        __global REAL *out = d_boxed + offset + (size_t)y * nx;
        __global const REAL *g =
            ROW_OF(frame, box[SCENE], 0, n_bands, y0 + y, ny_frame, nx_frame) + x0;
#if ROWS
        int x = 0;
        for (; x + LANES <= nx; x += LANES) {
            REAL sum[LANES];
            for (int l = 0; l < LANES; ++l) sum[l] = add ? out[x + l] : (REAL)0;
            for (int c = 0; c < n_bands; ++c) {
                const REAL ac = a[c];
                for (int l = 0; l < LANES; ++l) sum[l] += ac * g[c * band + x + l];
            }
            for (int l = 0; l < LANES; ++l) out[x + l] = sum[l];
        }
        for (; x < nx; ++x) {
#else
        FOR_X(x, nx) {
#endif
            REAL sum = add ? out[x] : (REAL)0;
            for (int c = 0; c < n_bands; ++c) sum += a[c] * g[c * band + x];
            out[x] = sum;
        }
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void gather_spectra(__global const int *restrict active, __global const int *restrict table,
                    __global const REAL *restrict frame,
                    __global const REAL *restrict boxed, const int n_channels, const int channel,
                    const int n_bands, const int ny_frame, const int nx_frame,
                    __global REAL *restrict d_spectra)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), c = (int)get_global_id(1);
    const int s = active[get_global_id(2)];
    HEAD(s)
    __global const REAL *g = ROW_OF(frame, box[SCENE], c, n_bands, y0, ny_frame, nx_frame) + x0;
    __global const REAL *m = boxed + offset;
    REAL total = 0;
#if ROWS
    /* sums of two vectors at a time, which hides the latency of additions */
    REAL part[LANES], other[LANES];
    for (int l = 0; l < LANES; ++l) part[l] = other[l] = 0;
    for (int y = 0; y < ny; ++y, m += nx, g += nx_frame) {
        int x = 0;
        for (; x + 2 * LANES <= nx; x += 2 * LANES)
            for (int l = 0; l < LANES; ++l) {
                part[l] += m[x + l] * g[x + l];
                other[l] += m[x + LANES + l] * g[x + LANES + l];
            }
        for (; x + LANES <= nx; x += LANES)
            for (int l = 0; l < LANES; ++l) part[l] += m[x + l] * g[x + l];
        for (; x < nx; ++x) total += m[x] * g[x];
    }
    for (int l = 0; l < LANES; ++l) part[l] += other[l];
    total += SUM8(part) + SUM8(part + 8);
#else
    for (int i = lid; i < ny * nx; i += WG) total += m[i] * g[(size_t)(i / nx) * nx_frame + i % nx];
#endif
    total = group_sum(total, lid, share);
    if (lid == 0) d_spectra[(size_t)s * n_channels + channel + c] = total;
}

__kernel void split_spectra(const int n_sources, const int n_bands, const int n_terms,
                    const int n_channels, const int channel, __global const REAL *restrict shares,
                    __global const REAL *restrict spectra, __global REAL *restrict parts)
{
    FOR_Y(s, n_sources) FOR_X(c, n_bands) {
        const REAL a = spectra[(size_t)s * n_channels + channel + c];
        const size_t at = ((size_t)s * n_bands + c) * n_terms;
        for (int t = 0; t < n_terms; ++t) parts[at + t] = a * shares[at + t];
    }
}

__kernel void merge_spectra(const int n_sources, const int n_bands, const int n_terms,
                      const int n_channels, const int channel,
                      __global const REAL *restrict shares, __global const REAL *restrict parts,
                      __global REAL *restrict spectra)
{
    FOR_Y(s, n_sources) FOR_X(c, n_bands) {
        const size_t at = ((size_t)s * n_bands + c) * n_terms;
        REAL sum = 0;
        for (int t = 0; t < n_terms; ++t) sum += shares[at + t] * parts[at + t];
        spectra[(size_t)s * n_channels + channel + c] = sum;
    }
}
