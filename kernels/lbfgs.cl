/* Projected L-BFGS for a batch of scenes: vectors stay on the device, the host decides.
 *
 * A vector consists of the variables of all scenes.  Each of its chunks belongs to one scene:
 *   chunks    (n, 4) int: scene, first element, length, whether its variables are at least 0
 *   ring_s, ring_hy (SLOTS, size)  changes of x in earlier iterations, and of g times the inverse
 *             of the curvature, one each in a slot
 *   plan      (B, 3) int: MODE, one of the modes below; USED, number of used slots, from the first
 *             on; SPARE, the slot among them for the changes of the trial
 * x, g: point and gradient of a scene; x_new, g_new: those of its trial; d: direction
 * h: the inverse of the curvature's diagonal.  A variable is held at its bound if bounded, x <= 0
 * and g > 0.  P g is g for free variables and 0 for held ones.
 * H: h, except for the variables in blocks, see block_inverse.cl
 *
 * form_pairs     s = x_new - x and h y into the spare slots, y = g_new - g, P g_new and h P g_new;
 *           scenes in mode REST are unchanged, here and below
 * inner_products  for each chunk the sums s_k . P g_new, H y_k . P g_new, s_k . y, H y_k . y of
 *           each slot k, g . s and x_new . precision x_new;  out (n, 4 SLOTS + 2)
 * take_step   NEXT: x, g, hg <- x_new, g_new, H P g_new, and
 *           d = P (scale (sum_k a_k H y_k - hg) - sum_k c_k s_k)
 *           AGAIN: the same d from the present x, g, hg;  TRY: the present d
 *           then x_new = x + length d, at least 0 where bounded;  STAY: x_new = x
 *           coefficients (B, 2 SLOTS + 2): a, c, scale, length
 * update_preconditioner  after new strengths of the prior: precision, h = 1 / (precision +
 *           curvature light), g_new += change x_new; launch: (WG, n_scales, n_free)
 *           weights (S, n_scales, 3): precision, curvature, change
 * launch of form_pairs, inner_products, take_step: (WG, n chunks), groups of (WG, 1)
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"
#ifndef SLOTS       /* of the ring: stored pairs and the spare one */
#define SLOTS 11
#endif
#define PLAN(b, what) plan[3 * (b) + what]
enum { MODE, USED, SPARE };
#define REST 0
#define NEXT 1
#define AGAIN 2
#define TRY 3
#define STAY 4
/* Parallel sums, and elements of a block, if a work-item has whole rows. */
#if ROWS
#define LANES 8
#define BLOCK 256
#else
#define LANES 1
#define BLOCK 1
#endif
#define CHUNK \
    const int lid = (int)get_local_id(0), chunk = (int)get_global_id(1); \
    const int b = chunks[4 * chunk], n = chunks[4 * chunk + 2]; \
    const int bounded = chunks[4 * chunk + 3]; \
    const size_t first = (size_t)chunks[4 * chunk + 1];

/* LANES running sums; ADD_LANES: their total in a private array's element q. */
#define SUMS(name) \
    REAL name[LANES]; \
    for (int l = 0; l < LANES; ++l) name[l] = 0;
#define ADD_LANES(name, total, q) \
    total[q] = 0; \
    for (int l = 0; l < LANES; ++l) total[q] += name[l];
/* The group's sums of N totals into a table. */
#define STORE_SUMS(total, N, to) \
    GROUP_SUMS(total, N, lid, share) \
    if (lid == 0) \
        for (int q = 0; q < (N); ++q) (to)[q] = total[q];
/* BODY for every element of this work-item: i, its lane l. */
#define FOR_LANES(n, BODY) \
    for (int i0 = lid * LANES; i0 + LANES <= (n); i0 += WG * LANES) \
        for (int l = 0; l < LANES; ++l) { \
            const int i = i0 + l; \
            BODY \
        } \
    for (int i = (n) / LANES * LANES + lid; i < (n); i += WG) { \
        const int l = 0; \
        BODY \
    }

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void form_pairs(__global const int *restrict chunks, __global const int *restrict plan,
           const ulong size, __global const REAL *restrict x, __global const REAL *restrict x_new,
           __global const REAL *restrict g, __global const REAL *restrict g_new,
           __global const REAL *restrict h, __global REAL *restrict ring_s,
           __global REAL *restrict ring_hy, __global REAL *restrict y,
           __global REAL *restrict projected, __global REAL *restrict hg_new)
{
    CHUNK
    if (PLAN(b, MODE) == REST) return;
    const size_t at = PLAN(b, SPARE) * (size_t)size + first;
    for (int i = lid; i < n; i += WG) {
        const REAL gi = g_new[first + i], yi = gi - g[first + i];
        const REAL p = bounded && x_new[first + i] <= 0 && gi > 0 ? (REAL)0 : gi;
        ring_s[at + i] = x_new[first + i] - x[first + i];
        ring_hy[at + i] = h[first + i] * yi;
        y[first + i] = yi;
        projected[first + i] = p;
        hg_new[first + i] = h[first + i] * p;
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void inner_products(__global const int *restrict chunks, __global const int *restrict plan,
            const ulong size, __global const REAL *restrict precision,
            __global const REAL *restrict x_new, __global const REAL *restrict g,
            __global const REAL *restrict y, __global const REAL *restrict projected,
            __global const REAL *restrict ring_s, __global const REAL *restrict ring_hy,
            __global REAL *restrict out)
{
    __local REAL share[4 * WG];
    CHUNK
    if (PLAN(b, MODE) == REST) return;
    __global REAL *to = out + (size_t)chunk * (4 * SLOTS + 2);
    __global const REAL *p = projected + first, *dg = y + first, *before = g + first;
    for (int k = 0; k < PLAN(b, USED); ++k) {
        __global const REAL *sk = ring_s + k * (size_t)size + first;
        __global const REAL *hyk = ring_hy + k * (size_t)size + first;
        SUMS(s_g)
        SUMS(y_g)
        SUMS(s_y)
        SUMS(y_y)
        FOR_LANES(n, {
            const REAL si = sk[i];
            const REAL hyi = hyk[i];
            s_g[l] += si * p[i];
            y_g[l] += hyi * p[i];
            s_y[l] += si * dg[i];
            y_y[l] += hyi * dg[i];
        })
        REAL total[4];
        ADD_LANES(s_g, total, 0)
        ADD_LANES(y_g, total, 1)
        ADD_LANES(s_y, total, 2)
        ADD_LANES(y_y, total, 3)
        STORE_SUMS(total, 4, to + 4 * k)
    }
    __global const REAL *weight = precision + first, *there = x_new + first;
    __global const REAL *s = ring_s + PLAN(b, SPARE) * (size_t)size + first;
    SUMS(slope)
    SUMS(energy)
    FOR_LANES(n, {
        slope[l] += before[i] * s[i];
        energy[l] += weight[i] * there[i] * there[i];
    })
    REAL both[2];
    ADD_LANES(slope, both, 0)
    ADD_LANES(energy, both, 1)
    STORE_SUMS(both, 2, to + 4 * SLOTS)
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void take_step(__global const int *restrict chunks, __global const int *restrict plan,
          __global const REAL *restrict coefficients, const ulong size,
          __global const REAL *restrict ring_s, __global const REAL *restrict ring_hy,
          __global const REAL *restrict g_new, __global const REAL *restrict hg_new,
          __global REAL *restrict x, __global REAL *restrict g, __global REAL *restrict hg,
          __global REAL *restrict d, __global REAL *restrict x_new)
{
    CHUNK
    const int now = PLAN(b, MODE);
    if (now == REST) return;
    __global const REAL *a = coefficients + b * (2 * SLOTS + 2), *c = a + SLOTS;
    const REAL scale = a[2 * SLOTS], length = a[2 * SLOTS + 1];
    for (int i0 = lid * BLOCK; i0 < n; i0 += WG * BLOCK) {
        const int m = n - i0 < BLOCK ? n - i0 : BLOCK;
        const size_t at = first + i0;
        if (now == NEXT)
            for (int i = 0; i < m; ++i) {
                x[at + i] = x_new[at + i];
                g[at + i] = g_new[at + i];
                hg[at + i] = hg_new[at + i];
            }
        if (now == NEXT || now == AGAIN) {
            REAL q[BLOCK];
            for (int i = 0; i < m; ++i) q[i] = -hg[at + i];
            for (int k = 0; k < PLAN(b, USED); ++k) {
                const REAL ak = a[k];
                __global const REAL *hy = ring_hy + k * (size_t)size + at;
                if (ak != 0) for (int i = 0; i < m; ++i) q[i] += ak * hy[i];
            }
            for (int i = 0; i < m; ++i) q[i] *= scale;
            for (int k = 0; k < PLAN(b, USED); ++k) {
                const REAL ck = c[k];
                __global const REAL *s = ring_s + k * (size_t)size + at;
                if (ck != 0) for (int i = 0; i < m; ++i) q[i] -= ck * s[i];
            }
            for (int i = 0; i < m; ++i)
                d[at + i] = bounded && x[at + i] <= 0 && g[at + i] > 0 ? (REAL)0 : q[i];
        }
        for (int i = 0; i < m; ++i) {
            const REAL to = now == STAY ? x[at + i] : x[at + i] + length * d[at + i];
            x_new[at + i] = bounded && to < 0 ? (REAL)0 : to;
        }
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void update_preconditioner(__global const int *restrict active,
             __global const int *restrict planes, __global const REAL *restrict weights,
             __global const REAL *restrict light, __global const REAL *restrict x_new,
             __global REAL *restrict g_new, __global REAL *restrict precision,
             __global REAL *restrict h)
{
    const int lid = (int)get_local_id(0);
    const int j = (int)get_global_id(1), n_scales = (int)get_global_size(1);
    const int i_plane = active[get_global_id(2)] * n_scales + j;
    const int n = planes[2 * i_plane + 1];
    const size_t first = (size_t)planes[2 * i_plane];
    const REAL stiff = weights[3 * i_plane], curvature = weights[3 * i_plane + 1];
    const REAL more = weights[3 * i_plane + 2];
    for (size_t i = first + lid; i < first + n; i += WG) {
        precision[i] = stiff;
        h[i] = 1 / (stiff + curvature * light[i]);
        g_new[i] += more * x_new[i];
    }
}
