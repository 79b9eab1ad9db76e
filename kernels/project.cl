/* The Euclidean projection of morphologies onto the monotone cone, by its dual, in place.
 *
 *   x = argmin 1/2 |x - y|^2   with  (B x)_i = x_i - sum_j w_ij x_j <= 0  but at the centre, x >= 0
 *
 *   z   <- max(0, y - B^T v)                  the image that belongs to the dual v
 *   new <- max(0, v + tau B z)                one ascent; tau_i = 1 / (|B| |B|^T 1)_i
 *   v   <- new + beta (new - l),  l <- new    momentum, dropped when (B z).(new - l) < 0
 *
 * until |new - l| < tolerance |y| or n_iterations; then x <- max(0, y - B^T l). l stays for the
 * next projection.
 *
 * A launch does the iterations first + 1 .. last, and continues the launch before it: on most
 * devices one launch does all n_iterations.
 *
 * Layout: a source of ny x nx pixels has a plane of (ny+2) x P elements, P = nx+2, its pixels
 * inside a rim of zeros, filled up to a multiple of ALIGN; plane s begins at ALIGN pads[s].
 *
 *              P = nx + 2
 *      +---+-----------+---+
 *      | 0 | 0  0  0  0| 0 |         neighbour d of pixel i is i + WAY(d), d in the order
 *      +---+-----------+---+
 *      | 0 |  pixels   | 0 | ny         0 1 2
 *      | 0 |           | 0 |            3 i 4
 *      +---+-----------+---+            5 6 7
 *      | 0 | 0  0  0  0| 0 |
 *      +---+-----------+---+
 *
 *   w (8 planes a source, at 8 ALIGN pads[s]): weights of the neighbours, times 1 - g; 0 on the rim
 *   tau, y, l, v, z, g, move (1 plane a source); x, table, active as in prox.cl
 *   momenta (S): the momentum after a launch, at least 1; 0 for a source that has converged
 *   values (2, S): the kind of weights (1 angle, 2 flat, 3 nearest, 0 skips the source), g
 *
 * Launch: n * WG work-items in groups of WG, one a source. WG 1 has no barrier and suits CPUs.
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"

#ifndef CHECK_EVERY /* iterations between checks of the sums, which cost about half an iteration */
#define CHECK_EVERY 4
#endif

#define HEAD \
    const int s = active[get_group_id(0)], lid = get_local_id(0); \
    __global const int *box = BOX(s); \
    const int ny = box[NY], nx = box[NX], P = nx + 2, begin = P + 1, end = (ny + 1) * P - 1; \
    const int n = ((ny + 2) * P + ALIGN - 1) / ALIGN * ALIGN; \
    const size_t base = (size_t)pads[s] * ALIGN;
/* All pixels, and the rim at the ends of rows, where w, tau and y are 0. */
#define FOR_INSIDE(i) for (int i = begin + lid; i < end; i += WG)
#define WAY(d) (((d) + ((d) > 3)) / 3 * P - P + ((d) + ((d) > 3)) % 3 - 1)
#define ALL_WAYS(f) f(0) f(1) f(2) f(3) f(4) f(5) f(6) f(7)

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void project_weights(__global REAL *restrict w, __global REAL *restrict tau,
                     __global REAL *restrict z, __global const int *table,
                     __global const int *pads, __global const int *active,
                     __global const REAL *values, const int n_sources)
{
    HEAD
    const int cy = box[CY], cx = box[CX], kind = (int)values[s];
    const REAL keep = 1 - values[n_sources + s];
    w += 8 * base;
    tau += base;
    z += base;
    FOR_INSIDE(i) {
        const int y = i / P - 1, x = i % P - 1;
        const bool pixel = x >= 0 && x < nx && kind != 0;
        REAL norm = 0, best = 0;
        for (int d = 0; d < 8; ++d) {
            const int e = d + (d > 3), dy = e / 3 - 1, dx = e % 3 - 1;
            const int inward = -(dy * (y - cy) + dx * (x - cx)), far = dy * dy + dx * dx;
            const bool inside = y + dy >= 0 && y + dy < ny && x + dx >= 0 && x + dx < nx;
            REAL weight = 0;
            if (pixel && inside && 2 * inward > far)
                weight = kind == 2 ? (REAL)1 : inward * (far == 2 ? SQRT_HALF : (REAL)1);
            best = weight > best ? weight : best;
            norm += weight;
            w[d * n + i] = weight;
        }
        for (int d = 0; d < 8; ++d) {
            const REAL weight = w[d * n + i];
            if (kind == 3)
                w[d * n + i] = weight == best && best > 0 ? keep : (REAL)0;
            else
                w[d * n + i] = norm > 0 ? keep * weight / norm : (REAL)0;
        }
        tau[i] = norm > 0 ? (REAL)1 : (REAL)0;
    }
    SYNC();
    FOR_INSIDE(i) {
#define COLUMN(d) +w[d * n + i - WAY(d)]
        z[i] = tau[i] ALL_WAYS(COLUMN);
    }
    SYNC();
    FOR_INSIDE(i) {
#define ROW(d) +w[d * n + i] * z[i + WAY(d)]
        tau[i] = tau[i] / (z[i] + (tau[i] > 0 ? (REAL)0 : (REAL)1) ALL_WAYS(ROW));
    }
}

/* Before a loop of one work-item over neighbouring pixels: vectorised wherever its buffers do
 * not overlap. Compilers check only so many pairs of pointers for overlap by themselves, fewer
 * than this loop has; with the pragma the projection is 2 to 3 times quicker on CPUs. */
#if WG > 1
#define VECTORISE
#else
#define VECTORISE _Pragma("clang loop vectorize(enable)")
#endif

/* z <- max(0, y - B^T v), or y - B^T v unless `positive` */
static void image(__global REAL *z, __global const REAL *y, __global const REAL *v,
                  __global const REAL *w, const int n, const int P, const int begin, const int end,
                  const int positive, const int lid)
{
    VECTORISE FOR_INSIDE(i) {
#define CHILD(d) +w[d * n + i - WAY(d)] * v[i - WAY(d)]
        const REAL value = y[i] - v[i] ALL_WAYS(CHILD);
        z[i] = positive && value < 0 ? (REAL)0 : value;
    }
}

/* The sum over a group of a[i] b[i]. */
static REAL inner(__global const REAL *a, __global const REAL *b, const int n, const int lid,
                  __local REAL *share)
{
    REAL sum[4] = {0, 0, 0, 0};
    for (int i = 4 * lid; i < n; i += 4 * WG) {
        sum[0] += a[i] * b[i];
        sum[1] += a[i + 1] * b[i + 1];
        sum[2] += a[i + 2] * b[i + 2];
        sum[3] += a[i + 3] * b[i + 3];
    }
    return group_sum((sum[0] + sum[1]) + (sum[2] + sum[3]), lid, share);
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void project(__global REAL *restrict x, __global const int *table, __global const int *pads,
             __global const int *active, __global const REAL *restrict w,
             __global const REAL *restrict tau, __global REAL *restrict y,
             __global REAL *restrict l, __global REAL *restrict v, __global REAL *restrict z,
             __global REAL *restrict g, __global REAL *restrict move,
             __global REAL *restrict momenta,
             __global const REAL *values, const int positive, const int first, const int last,
             const REAL tolerance)
{
    __local REAL share[WG];
    HEAD
    REAL momentum = first > 0 ? momenta[s] : (REAL)1;
    if (values[s] == 0 || momentum == 0) return;
    x += BEGIN(box);
    w += 8 * base;
    tau += base;
    y += base;
    l += base;
    v += base;
    z += base;
    g += base;
    move += base;
    if (first == 0) {
        for (int i = lid; i < ny * nx; i += WG) y[(i / nx + 1) * P + 1 + i % nx] = x[i];
        FOR_INSIDE(i) v[i] = l[i];
    }
    SYNC();
    const REAL small = tolerance * tolerance * inner(y, y, n, lid, share);
    for (int k = first + 1; k <= last && momentum > 0; ++k) {
        const REAL next = (1 + sqrt(1 + 4 * momentum * momentum)) / 2;
        const REAL beta = (momentum - 1) / next;
        momentum = next;
        image(z, y, v, w, n, P, begin, end, positive, lid);
        SYNC();
        FOR_INSIDE(i) {
#define PARENT(d) -w[d * n + i] * z[i + WAY(d)]
            const REAL ascent = z[i] ALL_WAYS(PARENT);
            const REAL free = v[i] + tau[i] * ascent, old = l[i];
            const REAL new = free > 0 ? free : (REAL)0;
            l[i] = new;
            v[i] = new + beta * (new - old);
            g[i] = ascent;
            move[i] = new - old;
        }
        SYNC();
        if (k % CHECK_EVERY == 0) {
            if (inner(g, move, n, lid, share) < 0) momentum = 1;
            if (inner(move, move, n, lid, share) <= small) momentum = 0;
        }
    }
    if (lid == 0) momenta[s] = momentum;
    image(z, y, l, w, n, P, begin, end, positive, lid);
    SYNC();
    for (int i = lid; i < ny * nx; i += WG) x[i] = z[(i / nx + 1) * P + 1 + i % nx];
}
