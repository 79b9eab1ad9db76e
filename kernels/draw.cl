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

enum { DRAW_NY, DRAW_NX, DRAW_N, DRAW_BEGIN, N_DRAW };
/* place in the box, C^-1 / w, s, m, b, b s^m, peak; c_0, c_1, c_2 of SersicProfile.wing_slopes; by
 * each of three parameters w dC (yy, yx, xx) and d ln(sqrt(det C) K). s falls as sqrt(det C) grows:
 * LIFT times the latter is by how much that changes q / w + s, with opposite sign */
enum {
    CY, CX, I_YY, I_YX, I_XX, SOFTNESS, POWER, FALL, REST, PEAK, LIFT, WINGS,
    SLOPES = WINGS + 3, N_SHAPE = SLOPES + 12
};

#define DARK ((REAL)1e-20)  /* of the peak; smaller values would be denormals, which are slow */

/* Pixels of a row that are drawn side by side, and a loop over the first of each. */
#if ROWS
#define LANES 8
#define FOR_LANES(x, n) for (int x = 0; x < (n); x += LANES)
#else
#define LANES 1
#define FOR_LANES(x, n) FOR_X(x, n)
#endif

#if ROWS && !defined(USE_DOUBLE)
/* ln x of 2^-126 <= x < 2^127: x = 2^n m, m in [sqrt(1/2), sqrt(2)), and ln m = 2 artanh(s) with
 * s = (m - 1) / (m + 1), |s| < 0.172: the truncated series has an error of 2e-9.  Unlike built-in
 * functions, plain arithmetic is vectorised over pixels by compilers for CPUs. */
static float ln(const float x)
{
    const int bits = as_int(x), over = (bits & 0x7fffff) > 0x3504f3;    /* m of sqrt(2) */
    const float m = as_float((bits & 0x7fffff) | (over ? 0x3f000000 : 0x3f800000));
    const float s = (m - 1) / (m + 1), t = s * s;
    const float series = 1 + t * (1 / 3.0f + t * (1 / 5.0f + t * (1 / 7.0f + t * (1 / 9.0f))));
    return ((bits >> 23) - 127 + over) * 0.69314718f + 2 * s * series;
}

/* e^x of |x| <= 60, less is below DARK: 2^n e^r with |r| <= ln 2 / 2; the truncated series has an
 * error of 5e-9. */
static float power_of_e(const float x)
{
    const float y = x < -60 ? -60 : x > 60 ? 60 : x;
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
#define LOG ln
#define EXP power_of_e
#else
#define LOG log
#define EXP exp
#endif

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
    const REAL dy = y - p[CY], cx = p[CX], yy = p[I_YY], yx = p[I_YX], xx = p[I_XX];
    const REAL soft = p[SOFTNESS], m = p[POWER], b = p[FALL], rest = p[REST], peak = p[PEAK];
#if K > 1
    const REAL lift = p[LIFT], c0 = p[WINGS], c1 = p[WINGS + 1], c2 = p[WINGS + 2];
#endif
    FOR_LANES(x, nx) {
        REAL image[K][LANES];
        for (int k = 0; k < LANES; ++k) {
            const REAL dx = x + k - cx;
            const REAL u = yy * dy + yx * dx, v = yx * dy + xx * dx, q = dy * u + dx * v;
            const REAL g = soft + q, l = LOG(g), power = EXP(m * l), e = EXP(rest - b * power);
            const REAL s0 = e > DARK ? peak * e : 0;
            image[0][k] = s0;
#if K > 1
            const REAL fall = b * m * power / g;
            for (int i = 0; i < 3; ++i) {
                const REAL cyy = p[SLOPES + 4 * i], cyx = p[SLOPES + 4 * i + 1];
                const REAL cxx = p[SLOPES + 4 * i + 2], d = p[SLOPES + 4 * i + 3];
                const REAL by_c = cyy * u * u + 2 * cyx * u * v + cxx * v * v;
                image[i + 1][k] = s0 * (fall * (by_c + lift * d) - d);
            }
            image[4][k] = s0 * (c0 + power * (c1 + c2 * l));
#endif
        }
        const int many = nx - x < LANES ? nx - x : LANES;
        for (int i = 0; i < n; ++i)
            for (int k = 0; k < many; ++k) out[i * one + x + k] = image[i][k];
    }
}
