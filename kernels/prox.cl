/* Constraints on morphologies: up to 8 steps in one launch, in place.
 *
 *   chain         x_s <- STEP7( ... STEP1(STEP0(x_s)))       for each active source s
 *   chain_factor  the same, and factor[s] = product of the divisors of the normalisations, times
 *                 its present value unless this is the first launch
 *
 * STEP0 .. STEP7 name functions of this file (-D STEP0=positivity ...); the last may be missing.
 *   x, table: the morphologies and their boxes, see boxes.h
 *   active  (n) int: sources to change; the others cost nothing
 *   values  (N_STEPS, 2, S) REAL: two parameters per step and source, named at each function
 *   step    of the gradient descent, multiplies penalties
 *
 * Boundary: nothing outside a box is read. Launch: n * WG work-items, groups of WG, one a source.
 *
 * The monotone sweep goes by levels l = 2 max(|dy|,|dx|) + min(|dy|,|dx|): every neighbour nearer
 * to the centre has a smaller level, so the pixels of one level are independent. A neighbour that
 * is not nearer has weight 0 and may have the same level, which other work-items write: it must not
 * be read. 0 times infinity would be NaN, and the comparison with a bound of NaN is false, so that
 * the pixel would not change.
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"

#ifndef OCTANTS     /* octants of a pixel for one work-item, which share the weights: 1, 2, 4, 8 */
#define OCTANTS (WG > 1 ? 1 : 8)
#endif

#define ARGUMENTS \
    __global REAL *x, const int ny, const int nx, const int cy, const int cx, \
    const REAL p, const REAL q, const REAL step, const int lid, __local REAL *share
#define FOR_PIXELS(i) for (int i = lid; i < ny * nx; i += WG)

/* x < 0 -> 0; p: 0 leaves the source alone. NaN stays NaN. */
static REAL positivity(ARGUMENTS)
{
    if (p != 0)
        FOR_PIXELS(i) x[i] = x[i] < 0 ? (REAL)0 : x[i];
    return 1;
}

/* Soft threshold at step * p. */
static REAL soft(ARGUMENTS)
{
    const REAL t = step * p;
    FOR_PIXELS(i) {
        const REAL v = x[i];
        x[i] = v > t ? v - t : (v < -t ? v + t : (v == v ? (REAL)0 : v));
    }
    return 1;
}

/* Hard threshold: 0 where x^2 <= 2 step p. */
static REAL hard(ARGUMENTS)
{
    const REAL t = 2 * step * p;
    if (t > 0)
        FOR_PIXELS(i) x[i] = x[i] * x[i] <= t ? (REAL)0 : x[i];
    return 1;
}

/* x -= p (x - mirror) / 2 about the centre, where the mirror pixel is in the box. */
static REAL symmetry(ARGUMENTS)
{
    const int ry = cy < ny - 1 - cy ? cy : ny - 1 - cy, rx = cx < nx - 1 - cx ? cx : nx - 1 - cx;
    const int width = 2 * rx + 1, n_pairs = ((2 * ry + 1) * width) / 2;
    const REAL h = (REAL)0.5 * p;
    __global REAL *first = x + (size_t)(cy - ry) * nx + cx - rx;
    __global REAL *last = x + (size_t)(cy + ry) * nx + cx + rx;
    for (int i = lid; i < n_pairs; i += WG) {
        const int k = (i / width) * nx + i % width;
        const REAL a = first[k], b = last[-k], d = h * (a - b);
        first[k] = a - d;
        last[-k] = b + d;
    }
    return 1;
}

/* Divide by `total`, if positive. Returns the divisor. */
static REAL divide(__global REAL *x, const int n, const REAL total, const int lid)
{
    if (!(total > 0)) return 1;
    for (int i = lid; i < n; i += WG) x[i] = x[i] / total;
    return total;
}

/* x / max(x), if p != 0. Four maxima each: independent comparisons. */
static REAL max_norm(ARGUMENTS)
{
    const int n = ny * nx;
    REAL most[4] = {x[0], x[0], x[0], x[0]};
    for (int i = lid * 4; i < n; i += WG * 4)
        for (int k = 0; k < 4; ++k) {
            const REAL v = x[i + k < n ? i + k : 0];
            most[k] = v > most[k] ? v : most[k];
        }
    REAL best = most[0];
    for (int k = 1; k < 4; ++k) best = most[k] > best ? most[k] : best;
    best = group_max(best, lid, share);
    return divide(x, n, p != 0 ? best : (REAL)0, lid);
}

/* x / sum(x), if p != 0. Four sums each: independent additions, and less rounding. */
static REAL sum_norm(ARGUMENTS)
{
    REAL sum[4] = {0, 0, 0, 0};
    const int n = ny * nx;
    for (int i = lid * 4; i < n; i += WG * 4) {
        sum[0] += x[i];
        sum[1] += i + 1 < n ? x[i + 1] : (REAL)0;
        sum[2] += i + 2 < n ? x[i + 2] : (REAL)0;
        sum[3] += i + 3 < n ? x[i + 3] : (REAL)0;
    }
    const REAL total = group_sum((sum[0] + sum[1]) + (sum[2] + sum[3]), lid, share);
    return divide(x, n, p != 0 ? total : (REAL)0, lid);
}

/* x_i <- min(x_i, (1 - q) sum_j w_ij x_j), level by level.
 * p: 0 leaves the source alone, 1 angle, 2 flat, 3 nearest. q: the minimal gradient g.
 *
 * A pixel is a >= b >= 0 steps from the centre along its long and short axis, in one of 8 octants
 * (bit 1: long axis negative, 2: short axis negative, 4: the long axis is y). Those nearer:
 *   (a-1, b) always;  (a-1, b-1) if b > 0 or a > 1;  (a, b-1) if b > 0;  (a-1, b+1) if a > b + 1.
 * Only (a-1, b+1), and (a-1, b-1) at b = 0, can leave the box: by the short axis.
 */
static REAL monotone(ARGUMENTS)
{
    const int kind = (int)p;
    if (kind == 0) return 1;
    const REAL keep = 1 - q;
    const int ry = cy > ny - 1 - cy ? cy : ny - 1 - cy, rx = cx > nx - 1 - cx ? cx : nx - 1 - cx;
    const int r_long = ry > rx ? ry : rx, r_short = ry > rx ? rx : ry;
    const int center = cy * nx + cx;
    for (int level = 2; level <= 2 * r_long + r_short; ++level) {
        int a_first = (level + 2) / 3, a_last = level / 2;
        if (a_first < (level - r_short + 1) / 2) a_first = (level - r_short + 1) / 2;
        if (a_last > r_long) a_last = r_long;
        for (int i = lid; i < 8 / OCTANTS * (a_last - a_first + 1); i += WG) {
            const int a = a_first + i * OCTANTS / 8, b = level - 2 * a;
            REAL w_in = a, w_diagonal = b > 0 || a > 1 ? (a + b) * SQRT_HALF : (REAL)0;
            REAL w_side = b, w_wide = a > b + 1 ? (a - b) * SQRT_HALF : (REAL)0;
            if (kind == 2) {
                w_in = 1;
                w_diagonal = w_diagonal > 0 ? 1 : 0;
                w_side = w_side > 0 ? 1 : 0;
                w_wide = w_wide > 0 ? 1 : 0;
            } else if (kind == 3) {
                w_in = 2 * a * a > (a + b) * (a + b) ? 1 : 0;
                w_diagonal = 1 - w_in;
                w_side = w_wide = 0;
            }
            const REAL part = keep / (w_in + w_diagonal + w_side + w_wide);
            for (int k = 0; k < OCTANTS; ++k) {
                const int octant = (i * OCTANTS + k) & 7;
                if ((b == 0 && (octant & 2)) || (a == b && (octant & 4))) continue;
                const int along = octant & 1 ? -a : a, across = octant & 2 ? -b : b;
                const int y = cy + (octant & 4 ? along : across);
                const int x_ = cx + (octant & 4 ? across : along);
                if (y < 0 || y >= ny || x_ < 0 || x_ >= nx) continue;
                const int long_stride = octant & 4 ? nx : 1, short_stride = octant & 4 ? 1 : nx;
                const int in = octant & 1 ? long_stride : -long_stride;
                const int out = octant & 2 ? -short_stride : short_stride;
                /* weight 0: another neighbour in place of one that may be of this level */
                const int diagonal = w_diagonal > 0 ? in - out : in;
                const int wide = w_wide > 0 ? in + out : in;
                const int at = y * nx + x_, side = octant & 4 ? x_ : y;
                const int n_side = octant & 4 ? nx : ny, t = octant & 2 ? -1 : 1;
                const bool has_wide = side + t >= 0 && side + t < n_side;
                const bool has_diagonal = side - t >= 0 && side - t < n_side;
                REAL most = w_in * x[at + in];
                if (has_diagonal && has_wide) {
                    most += w_diagonal * x[at + diagonal] + w_wide * x[at + wide];
                    most = part * (most + w_side * x[b > 0 ? at - out : at + in]);
                } else {
                    REAL norm = w_in + w_side;
                    most += w_side * x[b > 0 ? at - out : at + in];
                    most += has_diagonal ? w_diagonal * x[at + diagonal] : (REAL)0;
                    most += has_wide ? w_wide * x[at + wide] : (REAL)0;
                    norm += (has_diagonal ? w_diagonal : (REAL)0) + (has_wide ? w_wide : (REAL)0);
                    most *= keep / norm;
                }
                const REAL value = x[at];
                x[at] = value > most ? most : value;
            }
        }
        SYNC();
    }
    return 1;
}

#define RUN(f, k) \
    scale *= f(x, ny, nx, cy, cx, values[(2 * (k)) * (size_t)n_sources + s], \
               values[(2 * (k) + 1) * (size_t)n_sources + s], step, lid, share); \
    SYNC();

static REAL run(__global REAL *x, const int ny, const int nx, const int cy, const int cx,
                __global const REAL *values, const int n_sources, const int s, const REAL step,
                const int lid, __local REAL *share)
{
    REAL scale = 1;
#ifdef STEP0
    RUN(STEP0, 0)
#endif
#ifdef STEP1
    RUN(STEP1, 1)
#endif
#ifdef STEP2
    RUN(STEP2, 2)
#endif
#ifdef STEP3
    RUN(STEP3, 3)
#endif
#ifdef STEP4
    RUN(STEP4, 4)
#endif
#ifdef STEP5
    RUN(STEP5, 5)
#endif
#ifdef STEP6
    RUN(STEP6, 6)
#endif
#ifdef STEP7
    RUN(STEP7, 7)
#endif
    return scale;
}

#define HEAD \
    __local REAL share[WG]; \
    const int s = active[get_group_id(0)], lid = get_local_id(0); \
    __global const int *box = BOX(s); \
    x += BEGIN(box);
#define RUN_ALL \
    run(x, box[NY], box[NX], box[CY], box[CX], values, n_sources, s, step, lid, share)

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void chain(__global REAL *restrict x, __global const int *table, __global const int *active,
           __global const REAL *values, const int n_sources, const REAL step)
{
    HEAD
    RUN_ALL;
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void chain_factor(__global REAL *restrict x, __global const int *table, __global const int *active,
                  __global const REAL *values, const int n_sources, const REAL step,
                  __global REAL *factor, const int first)
{
    HEAD
    const REAL scale = RUN_ALL;
    if (lid == 0) factor[s] = first ? scale : factor[s] * scale;
}
