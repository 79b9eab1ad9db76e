/* Structure of galaxies at several scales about their profiles, and its transpose.
 *
 *   u_s = amp_s o sum_j K_j z_sj              amp = sqrt(profile)
 *   S_s = max(0, b + u - b <b, u> / <b, b>)   b: the profile; the light along b is the spectrum's
 *
 * K_j is a Gaussian of standard deviation sigma_j [px], cut at RADII[j]; its coefficients z_sj lie
 * on every STEPS[j]-th pixel of the box, COARSE(ny, j) x COARSE(nx, j) of them, row by row, scale
 * after scale from LATENTS on in the solver's vectors.  A step of sigma or less loses nothing: the
 * kernel holds no frequency that the coarse grid lacks (0.7 % of its amplitude at most).
 *
 * spread     u = amp o sum_j K_j z;  launch: (X, tallest box, n_free)
 * form       S from u, the gauge with it;  launch: (WG, n_free), groups (WG, 1)
 * unform     q = amp o (v - b <b, v> / <b, b>), v = dS where S > 0, over dS;  launch: as form
 * condense   g = K_j^T q + precision[s, j] z for every scale;  launch: (X, COARSE rows, n_free)
 * energy     out[s, j] = sum z_sj^2 of the sources listed;      launch: (WG, n_scales, n_free)
 *
 * taps       N_SCALES rows of TAPS: K_j along one axis, zeros after 2 RADII[j] + 1 of them, up to a
 *            multiple of 8 at least
 * line       zeros; scratch of a source from LINES on, LINE(nx) for each row of either
 *            kernel: a row of one pass, with MARGIN zeros before it, and as many and 16 more behind
 * MARGIN     a multiple of ALIGN, the largest of RADII at least
 * start      (S, 2) int: of LATENTS and LINES, in units of ALIGN elements
 * table, flat buffers: see boxes.h.  X is 1 where a work-item walks a whole row (ROWS), else the
 * widest row: there each pixel is one sum over two axes, and `line` is not used.
 */
#include "common.h"
#include "boxes.h"
#include "group.h"
#ifndef N_SCALES    /* J, of which RADII, STEPS and rows of taps are given */
#define N_SCALES 3
#endif
#ifndef RADII       /* pixels */
#define RADII {3, 6, 15}
#endif
#ifndef STEPS       /* pixels, powers of two */
#define STEPS {1, 2, 4}
#endif
#ifndef TAPS        /* elements of a row of taps */
#define TAPS 32
#endif
#ifndef MARGIN      /* zeros before a row of line; ALIGN more behind, so that whole vectors fit */
#define MARGIN 16
#endif
#define LINE(nx) (((nx) + ALIGN - 1) / ALIGN * ALIGN + 2 * MARGIN + ALIGN)
#define COARSE(n, step) (((n) + (step) - 2) / (step) + 1)

__constant int radii[N_SCALES] = RADII;
__constant int steps[N_SCALES] = STEPS;

#define HEAD(s) \
    __global const int *place = BOX(s); \
    const int ny = place[NY], nx = place[NX]; \
    const size_t box = BEGIN(place);
#define LATENTS(s) ((size_t)start[2 * (s)] * ALIGN)
#define LINES(s) ((size_t)start[2 * (s) + 1] * ALIGN)

#if ROWS
/* out[x] += sum_c taps[x - step c + radius] line[c]; line: zero for `MARGIN` before and behind. */
static void upsample(__global const REAL *line, __global const REAL *taps,
                     const int nx, const int step, const int radius, __global REAL *out)
{
    for (int phase = 0; phase < step; ++phase) {
        const int low = -((radius - phase) / step), high = (radius + phase) / step;
        for (int i0 = 0; step * i0 + phase < nx; i0 += 8) {
            REAL sum[8] = {0, 0, 0, 0, 0, 0, 0, 0};
            for (int o = low; o <= high; ++o) {
                const REAL k = taps[phase - step * o + radius];
                for (int l = 0; l < 8; ++l) sum[l] += k * line[i0 + o + l];
            }
            for (int l = 0; l < 8; ++l) {
                const int x = step * (i0 + l) + phase;
                if (x < nx) out[x] += sum[l];
            }
        }
    }
}
#endif

__kernel void spread(__global const int *restrict active, __global const int *restrict table,
                     __global const int *restrict start, __global const REAL *restrict taps,
                     __global const REAL *restrict z, __global const REAL *restrict amp,
                     __global REAL *restrict line, __global REAL *restrict u)
{
    const int s = active[get_global_id(2)], y = (int)get_global_id(1);
    HEAD(s)
    if (y >= ny) return;
    __global const REAL *plane = z + LATENTS(s);
    __global REAL *out = u + box + (size_t)y * nx;
#if ROWS
    __global REAL *row = line + LINES(s) + (size_t)y * LINE(nx) + MARGIN;
    for (int x = 0; x < nx; ++x) out[x] = 0;
    for (int j = 0; j < N_SCALES; ++j) {
        const int step = steps[j], radius = radii[j];
        const int cy = COARSE(ny, step), cx = COARSE(nx, step);
        const int low = y - radius > 0 ? (y - radius + step - 1) / step : 0;
        const int top = (y + radius) / step, high = top < cy - 1 ? top : cy - 1;
        __global const REAL *k = taps + (size_t)j * TAPS + y + radius;
        int c = 0;
        for (; c + 8 <= cx; c += 8) {
            REAL sum[8] = {0, 0, 0, 0, 0, 0, 0, 0};
            for (int r = low; r <= high; ++r)
                for (int l = 0; l < 8; ++l) sum[l] += k[-step * r] * plane[(size_t)r * cx + c + l];
            for (int l = 0; l < 8; ++l) row[c + l] = sum[l];
        }
        for (; c < cx; ++c) {
            REAL sum = 0;
            for (int r = low; r <= high; ++r) sum += k[-step * r] * plane[(size_t)r * cx + c];
            row[c] = sum;
        }
        for (int m = cx; m < cx + MARGIN; ++m) row[m] = 0;
        upsample(row, taps + (size_t)j * TAPS, nx, step, radius, out);
        plane += (size_t)cy * cx;
    }
    for (int x = 0; x < nx; ++x) out[x] *= amp[box + (size_t)y * nx + x];
#else
    const int x = (int)get_global_id(0);
    if (x >= nx) return;
    REAL total = 0;
    for (int j = 0; j < N_SCALES; ++j) {
        const int step = steps[j], radius = radii[j];
        const int cy = COARSE(ny, step), cx = COARSE(nx, step);
        __global const REAL *k = taps + (size_t)j * TAPS + radius;
        const int c0 = x - radius > 0 ? (x - radius + step - 1) / step : 0;
        for (int r = y - radius > 0 ? (y - radius + step - 1) / step : 0;
             r < cy && step * r <= y + radius; ++r) {
            REAL sum = 0;
            for (int c = c0; c < cx && step * c <= x + radius; ++c)
                sum += k[x - step * c] * plane[(size_t)r * cx + c];
            total += k[y - step * r] * sum;
        }
        plane += (size_t)cy * cx;
    }
    out[x] = amp[box + (size_t)y * nx + x] * total;
#endif
}

/* sum_i VALUE over i < n by all work-items of a group, each of which gets it. */
#define SUM_OVER(total, n, VALUE) \
    REAL part[8] = {0, 0, 0, 0, 0, 0, 0, 0}; \
    for (int i0 = 8 * lid; i0 < (n); i0 += 8 * WG) \
        for (int l = 0; l < 8; ++l) { \
            const int i = i0 + l; \
            if (i < (n)) part[l] += VALUE; \
        } \
    const REAL total = group_sum(SUM8(part), lid, share);

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void form(__global const int *restrict active, __global const int *restrict table,
          __global const REAL *restrict inverse, __global const REAL *restrict profile,
          __global const REAL *restrict u, __global REAL *restrict morph)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), s = active[get_global_id(1)];
    HEAD(s)
    const int n = ny * nx;
    __global const REAL *b = profile + box;
    __global const REAL *in = u + box;
    __global REAL *out = morph + box;
    SUM_OVER(along, n, b[i] * in[i])
    const REAL rest = 1 - along * inverse[s];
    for (int i = lid; i < n; i += WG) {
        const REAL value = b[i] * rest + in[i];
        out[i] = value > 0 ? value : (REAL)0;
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void unform(__global const int *restrict active, __global const int *restrict table,
            __global const REAL *restrict inverse, __global const REAL *restrict profile,
            __global const REAL *restrict amp, __global const REAL *restrict morph,
            __global REAL *restrict d_morph)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), s = active[get_global_id(1)];
    HEAD(s)
    const int n = ny * nx;
    __global const REAL *b = profile + box;
    __global const REAL *a = amp + box;
    __global const REAL *m = morph + box;
    __global REAL *d = d_morph + box;
    SUM_OVER(along, n, (m[i] > 0 ? b[i] * d[i] : (REAL)0))
    const REAL less = along * inverse[s];
    for (int i = lid; i < n; i += WG) d[i] = a[i] * ((m[i] > 0 ? d[i] : (REAL)0) - b[i] * less);
}

/* Eight coefficients of a row at a time, of a step that is known when this is compiled. */
#define ALONG_ROW(STEP) \
    for (; c + 8 <= cx; c += 8) { \
        REAL sum[8] = {0, 0, 0, 0, 0, 0, 0, 0}; \
        __global const REAL *from = row + STEP * c - radius; \
        for (int t = 0; t <= 2 * radius; ++t) \
            for (int l = 0; l < 8; ++l) sum[l] += k[t] * from[STEP * l + t]; \
        for (int l = 0; l < 8; ++l) \
            gradient[at + c + l] = sum[l] + weight * z[at + c + l]; \
    }

__kernel void condense(__global const int *restrict active, __global const int *restrict table,
                       __global const int *restrict start, __global const REAL *restrict taps,
                       __global const REAL *restrict q, __global const REAL *restrict precision,
                       __global const REAL *restrict z, __global REAL *restrict line,
                       __global REAL *restrict gradient)
{
    const int s = active[get_global_id(2)];
    HEAD(s)
    size_t plane = LATENTS(s);
    int r = (int)get_global_id(1), j = 0, step = steps[0];
    int cy = COARSE(ny, step), cx = COARSE(nx, step);
    while (r >= cy) {
        r -= cy;
        plane += (size_t)cy * cx;
        if (++j == N_SCALES) return;
        step = steps[j];
        cy = COARSE(ny, step);
        cx = COARSE(nx, step);
    }
    const int radius = radii[j], middle = step * r;
    const int low = middle > radius ? middle - radius : 0;
    const int high = middle + radius < ny - 1 ? middle + radius : ny - 1;
    __global const REAL *k = taps + (size_t)j * TAPS;
    __global const REAL *in = q + box;
    const size_t at = plane + (size_t)r * cx;
    const REAL weight = precision[s * N_SCALES + j];
#if ROWS
    __global REAL *row =
        line + LINES(s) + (size_t)get_global_id(1) * LINE(nx) + MARGIN;
    int x = 0;
    for (; x + 8 <= nx; x += 8) {
        REAL sum[8] = {0, 0, 0, 0, 0, 0, 0, 0};
        for (int y = low; y <= high; ++y) {
            const REAL ky = k[y - middle + radius];
            for (int l = 0; l < 8; ++l) sum[l] += ky * in[(size_t)y * nx + x + l];
        }
        for (int l = 0; l < 8; ++l) row[x + l] = sum[l];
    }
    for (; x < nx; ++x) {
        REAL sum = 0;
        for (int y = low; y <= high; ++y) sum += k[y - middle + radius] * in[(size_t)y * nx + x];
        row[x] = sum;
    }
    for (int m = nx; m < LINE(nx) - MARGIN; ++m) row[m] = 0;
    int c = 0;
    if (step == 1) ALONG_ROW(1)
    if (step == 2) ALONG_ROW(2)
    for (; c < cx; ++c) {
        REAL sum[8] = {0, 0, 0, 0, 0, 0, 0, 0};
        for (int t = 0; t <= 2 * radius; t += 8)
            for (int l = 0; l < 8; ++l) sum[l] += k[t + l] * row[step * c - radius + t + l];
        gradient[at + c] = SUM8(sum) + weight * z[at + c];
    }
#else
    const int c = (int)get_global_id(0);
    if (c >= cx) return;
    const int left = step * c > radius ? step * c - radius : 0;
    const int right = step * c + radius < nx - 1 ? step * c + radius : nx - 1;
    REAL total = 0;
    for (int y = low; y <= high; ++y) {
        REAL sum = 0;
        for (int x = left; x <= right; ++x)
            sum += k[x - step * c + radius] * in[(size_t)y * nx + x];
        total += k[y - middle + radius] * sum;
    }
    gradient[at + c] = total + weight * z[at + c];
#endif
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void energy(__global const int *restrict active, __global const int *restrict table,
            __global const int *restrict start, __global const REAL *restrict z,
            __global REAL *restrict out)
{
    __local REAL share[WG];
    const int lid = (int)get_local_id(0), j = (int)get_global_id(1), s = active[get_global_id(2)];
    const int ny = BOX(s)[NY], nx = BOX(s)[NX];
    __global const REAL *plane = z + LATENTS(s);
    for (int k = 0; k < j; ++k) plane += (size_t)COARSE(ny, steps[k]) * COARSE(nx, steps[k]);
    const int n = COARSE(ny, steps[j]) * COARSE(nx, steps[j]);
    SUM_OVER(total, n, plane[i] * plane[i])
    if (lid == 0) out[s * N_SCALES + j] = total;
}
