/* Structure of galaxies at several scales about their profiles, and its transpose.
 *
 *   u_s = amp_s o sum_j K_j z_sj              amp = sqrt(profile)
 *   S_s = max(0, b + u - b <b, u> / <b, b>)   b: the profile, on which u has no projection
 *
 * K_j is a Gaussian of standard deviation sigma_j [px], cut at RADII[j]; its coefficients z_sj lie
 * on every STEPS[j]-th pixel of the box, COARSE(ny, j) x COARSE(nx, j) of them, row by row, scale
 * after scale from LATENTS on in the solver's vectors.  A step of at most sigma loses nothing: at
 * the coarse grid's Nyquist frequency the kernel has at most 0.7 % of its amplitude.
 *
 * coefficients_to_image     u = amp o sum_j K_j z;  launch: (X, Y, n_free)
 * form_morphology       S from u, the gauge with it;  launch: (WG, n_free), groups (WG, 1)
 * morphology_adjoint  q = amp o (v - b <b, v> / <b, b>), v = dS where S > 0, over dS;  launch: as
 *     for form_morphology
 * image_to_coefficients  g = K_j^T q + precision[s, j] z for every scale;  launch: (X, Y, n_free)
 * coefficient_norms  out[s, j] = sum z_sj^2 of the sources listed;      launch: (WG, n_scales,
 *     n_free)
 *
 * taps       N_SCALES rows of TAPS: K_j along one axis, at least one zero after 2 RADII[j] + 1
 * line       zeros; scratch of a source from LINES on, LINE(nx) for each row of either
 *            kernel: a row of one pass, with MARGIN zeros before it, and as many and 16 more behind
 * MARGIN     a multiple of ALIGN, the largest of RADII and of STEPS together at least
 * start      (S, 2) int: of LATENTS and LINES, in units of ALIGN elements
 * table, flat buffers: see boxes.h.  X is 1 where a work-item walks a whole row (ROWS), else any
 * number, as Y is: there each pixel is one sum over two axes, and `line` is not used.
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"
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
#define MARGIN 32
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
/* Neighbouring elements, which begin anywhere. */
typedef REAL EIGHT __attribute__((ext_vector_type(8), aligned(sizeof(REAL))));
typedef REAL SIXTEEN __attribute__((ext_vector_type(16), aligned(sizeof(REAL))));

/* to[step i] = sum_r<n_rows k[r k_step] rows[r ld + i], i from `i` on, as many as VECTOR has. */
#define SUM_ROWS(VECTOR, N) { \
    VECTOR sum = (VECTOR)(0); \
    for (int r = 0; r < n_rows; ++r) sum += k[r * k_step] * AT(const VECTOR, rows + r * ld + i); \
    if (step == 1) AT(VECTOR, to + i) = sum; \
    else UNROLL(l, N) to[step * (i + l)] = sum[l]; \
}

/* The same for all i < n. */
INLINE void sum_rows(__global const REAL *rows, const int n_rows, const int ld,
                     __global const REAL *k, const int k_step, const int n,
                     __global REAL *to, const int step)
{
    int i = 0;
    for (; i + 16 <= n; i += 16) SUM_ROWS(SIXTEEN, 16)
    for (; i + 8 <= n; i += 8) SUM_ROWS(EIGHT, 8)
    if (i < n && n >= 8) {      /* the last eight, some of them once more */
        i = n - 8;
        SUM_ROWS(EIGHT, 8)
        return;
    }
    for (; i < n; ++i) {
        REAL sum = 0;
        for (int r = 0; r < n_rows; ++r) sum += k[r * k_step] * rows[r * ld + i];
        to[step * i] = sum;
    }
}

/* *sum = sum_t<=2 radius k[t] line[x - radius + t] at sixteen x from line[0] on; k[2 radius + 1] is
 * 0. By a pointer: Clang warns of wide vectors that are returned on CPUs without them. */
INLINE void smoothed(__global const REAL *line, __global const REAL *k, const int radius,
                     SIXTEEN *sum)
{
    SIXTEEN even = (SIXTEEN)(0), odd = (SIXTEEN)(0);
    line -= radius;
    for (int t = 0; t <= 2 * radius; t += 2) {
        even += k[t] * AT(const SIXTEEN, line + t);
        odd += k[t + 1] * AT(const SIXTEEN, line + t + 1);
    }
    *sum = even + odd;
}
#endif

__kernel void coefficients_to_image(__global const int *restrict active,
        __global const int *restrict table,
                     __global const int *restrict start, __global const REAL *restrict taps,
                     __global const REAL *restrict z, __global const REAL *restrict amp,
                     __global REAL *restrict line, __global REAL *restrict u)
{
    const int s = active[get_global_id(2)];
    HEAD(s)
    FOR_Y(y, ny) {
        __global const REAL *plane = z + LATENTS(s);
        __global REAL *out = u + box + (size_t)y * nx;
#if ROWS
        __global REAL *row = line + LINES(s) + (size_t)y * LINE(nx) + MARGIN;
        for (int j = 0; j < N_SCALES; ++j) {
            const int step = steps[j], radius = radii[j];
            const int cy = COARSE(ny, step), cx = COARSE(nx, step);
            const int low = y - radius > 0 ? (y - radius + step - 1) / step : 0;
            const int top = (y + radius) / step, high = top < cy - 1 ? top : cy - 1;
            __global const REAL *k = taps + (size_t)j * TAPS;
            /* coefficients on the pixels that they belong to, zeros between them */
            for (int m = 0; m < LINE(nx) - MARGIN; ++m) row[m] = 0;
            sum_rows(plane + (size_t)low * cx, high - low + 1, cx, k + y + radius - step * low,
                     -step, cx, row, step);
            int x = 0;
            for (; x + 16 <= nx; x += 16) {
                SIXTEEN sum;
                smoothed(row + x, k, radius, &sum);
                if (j) sum += AT(const SIXTEEN, out + x);
                AT(SIXTEEN, out + x) = sum;
            }
            if (x < nx) {
                SIXTEEN sum;
                smoothed(row + x, k, radius, &sum);
                for (int l = 0; x + l < nx; ++l) out[x + l] = (j ? out[x + l] : (REAL)0) + sum[l];
            }
            plane += (size_t)cy * cx;
        }
        for (int x = 0; x < nx; ++x) out[x] *= amp[box + (size_t)y * nx + x];
#else
        FOR_X(x, nx) {
            __global const REAL *own = plane;
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
                        sum += k[x - step * c] * own[(size_t)r * cx + c];
                    total += k[y - step * r] * sum;
                }
                own += (size_t)cy * cx;
            }
            out[x] = amp[box + (size_t)y * nx + x] * total;
        }
#endif
    }
}

/* sum_i VALUE over i < n by all work-items of a group, each of which gets it. Where a work-item has
 * whole rows eights come first: with a test of each i among them compilers do not vectorise. */
#if ROWS
#define SUM_OVER(total, n, VALUE) \
    REAL part[8] = {0, 0, 0, 0, 0, 0, 0, 0}; \
    for (int i0 = 8 * lid; i0 + 8 <= (n); i0 += 8 * WG) \
        for (int l = 0; l < 8; ++l) { \
            const int i = i0 + l; \
            part[l] += VALUE; \
        } \
    for (int i = (n) / 8 * 8 + lid; i < (n); i += WG) part[0] += VALUE; \
    const REAL total = group_sum(SUM8(part), lid, share);
#else
#define SUM_OVER(total, n, VALUE) \
    REAL part[1] = {0}; \
    for (int i = lid; i < (n); i += WG) part[0] += VALUE; \
    GROUP_SUMS(part, 1, lid, share) \
    const REAL total = part[0];
#endif

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void form_morphology(__global const int *restrict active, __global const int *restrict table,
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
void morphology_adjoint(__global const int *restrict active, __global const int *restrict table,
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
    for (int i = lid; i < n; i += WG) {
        const REAL di = m[i] > 0 ? d[i] : (REAL)0;
        d[i] = a[i] * (di - b[i] * less);
    }
}

__kernel void image_to_coefficients(__global const int *restrict active,
        __global const int *restrict table,
                       __global const int *restrict start, __global const REAL *restrict taps,
                       __global const REAL *restrict q, __global const REAL *restrict precision,
                       __global const REAL *restrict z, __global REAL *restrict line,
                       __global REAL *restrict gradient)
{
    const int s = active[get_global_id(2)];
    HEAD(s)
    int n_rows = 0;
    for (int i = 0; i < N_SCALES; ++i) n_rows += COARSE(ny, steps[i]);
    FOR_Y(of_all, n_rows) {
        size_t plane = LATENTS(s);
        int r = of_all, j = 0, step = steps[0];
        int cy = COARSE(ny, step), cx = COARSE(nx, step);
        while (r >= cy) {
            r -= cy;
            plane += (size_t)cy * cx;
            step = steps[++j];
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
        __global REAL *row = line + LINES(s) + (size_t)of_all * LINE(nx) + MARGIN;
        sum_rows(in + (size_t)low * nx, high - low + 1, nx, k + low - middle + radius, 1, nx, row,
                 1);
        for (int m = nx; m < LINE(nx) - MARGIN; ++m) row[m] = 0;
        /* at all pixels, of which a coefficient belongs to every `step`-th */
        for (int x = 0; x <= step * (cx - 1); x += step > 16 ? step : 16) {
            SIXTEEN sum;
            smoothed(row + x, k, radius, &sum);
            if (step == 1 && x + 16 <= cx) {
                const SIXTEEN own = AT(const SIXTEEN, z + at + x);
                AT(SIXTEEN, gradient + at + x) = sum + weight * own;
            } else
                for (int l = 0; l < 16 && x + l <= step * (cx - 1); l += step) {
                    const size_t c = at + (x + l) / step;
                    gradient[c] = sum[l] + weight * z[c];
                }
        }
#else
        FOR_X(c, cx) {
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
        }
#endif
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void coefficient_norms(__global const int *restrict active, __global const int *restrict table,
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
