/* Smooth profiles, and their slopes by their parameters, drawn in boxes.
 *
 * draw_profiles  (slots, N_DRAW) int: ny, nx, n, first element of its images (n, ny, nx); n = 0:
 *          not drawn here, at most K.  shape (slots, N_SHAPE), see the enum: profile and its slopes
 *          by (ln sigma, g1, g2, ln beta), see profiles.py;  launch: (X, tallest box, slots)
 *
 * X is 1 where a work-item walks a whole row (ROWS of work_group.h), else the width of the widest
 *     row.
 */
#include "common.h"
#include "work_group.h"
#ifndef K           /* images of a slot: 1, or 5 with slopes */
#define K 1
#endif
#ifndef N_GAUSSIANS /* of a profile */
#define N_GAUSSIANS 12
#endif

enum { DRAW_NY, DRAW_NX, DRAW_N, DRAW_BEGIN, N_DRAW };
/* place in the box; of each Gaussian, e = exp(-(yy y^2 + yx y x + xx x^2)), yy, yx, xx, its peak,
 * and if there are slopes its factors in each: of e y^2, e y x, e x^2 and e */
enum { CY, CX, FIRST };
enum { YY, YX, XX, PEAK, SLOPES, N_GAUSSIAN = SLOPES + 4 * (K - 1) };
#define N_SHAPE (FIRST + N_GAUSSIANS * N_GAUSSIAN)

/* Pixels of a row that are drawn side by side, and a loop over the first of each. */
#if ROWS
#define LANES 8
#define FOR_LANES(x, n) for (int x = 0; x < (n); x += LANES)
#else
#define LANES 1
#define FOR_LANES(x, n) FOR_X(x, n)
#endif

#if ROWS && !defined(USE_DOUBLE)
/* e^x of x >= -60, else e^-60: 2^n e^r with |r| <= ln 2 / 2; the truncated series has an error of
 * 5e-9.  Unlike the built-in function, plain arithmetic is vectorised over pixels by compilers for
 * CPUs. */
static float power_of_e(const float x)
{
    const float y = x < -60 ? -60 : x;
    const int n = (int)(y * 1.44269504f + 127.5f) - 127;
    const float r = (y - n * 0.693359375f) + n * 2.12194440e-4f;   /* the first has 10 bits */
    float sum = 1 + r * (1 / 7.0f);
    sum = 1 + r * (1 / 6.0f) * sum;
    sum = 1 + r * (1 / 5.0f) * sum;
    sum = 1 + r * (1 / 4.0f) * sum;
    sum = 1 + r * (1 / 3.0f) * sum;
    sum = 1 + r * (1 / 2.0f) * sum;
    sum = 1 + r * sum;
    return as_float((n + 127) << 23) * sum;
}
#define EXP power_of_e
#else
#define EXP exp
#endif
#define NO_LIGHT 46     /* e^-46, 1e-20, is none; far smaller ones would be denormal, and slow */

__kernel void draw_profiles(__global const int *restrict table, __global const REAL *restrict shape,
                   __global REAL *restrict images)
{
    const int s = (int)get_global_id(2), y = (int)get_global_id(1);
    __global const int *t = table + N_DRAW * (size_t)s;
    const int ny = t[DRAW_NY], nx = t[DRAW_NX], n = t[DRAW_N];
    if (!n || y >= ny) return;
    __global const REAL *p = shape + N_SHAPE * (size_t)s;
    __global REAL *out = images + t[DRAW_BEGIN] + (size_t)y * nx;
    const size_t one = (size_t)ny * nx;
    const REAL dy = y - p[CY], cx = p[CX];
    FOR_LANES(x, nx) {
        REAL image[K][LANES];
        for (int i = 0; i < K; ++i)
            for (int k = 0; k < LANES; ++k) image[i][k] = 0;
        for (int j = 0; j < N_GAUSSIANS; ++j) {
            __global const REAL *g = p + FIRST + N_GAUSSIAN * j;
            const REAL yy = g[YY] * dy * dy, yx = g[YX] * dy, xx = g[XX];
            REAL e[LANES];
            for (int k = 0; k < LANES; ++k) {
                const REAL dx = x + k - cx;
                const REAL q = yy + dx * (yx + xx * dx);
                e[k] = q < NO_LIGHT ? EXP(-q) : 0;
                image[0][k] += g[PEAK] * e[k];
            }
            for (int i = 1; i < K; ++i) {
                __global const REAL *f = g + SLOPES + 4 * (i - 1);
                const REAL none = f[0] * dy * dy + f[3], one = f[1] * dy, two = f[2];
                for (int k = 0; k < LANES; ++k) {
                    const REAL dx = x + k - cx;
                    image[i][k] += e[k] * (none + dx * (one + two * dx));
                }
            }
        }
        const int many = nx - x < LANES ? nx - x : LANES;
        for (int i = 0; i < n; ++i)
            for (int k = 0; k < many; ++k) out[i * one + x + k] = image[i][k];
    }
}
