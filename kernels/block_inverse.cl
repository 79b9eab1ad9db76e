/* Applies the block-diagonal inverse curvature to vectors: part of the solver of lbfgs.cl.
 *
 * A block is the inverse of a part of the curvature, W^T W with a triangular factor W, its root.
 *   blocks    (n, 4) int: scene, variables m, the first of its indices, first element of its root
 *             / ALIGN;  indices: of the variables;  roots: W of each, lower triangular, in panels
 *             of PANEL rows that end with their last one's diagonal; zeros beyond
 *   plan      (B, 3) int, see lbfgs.cl: blocks of idle scenes are skipped
 *
 * apply_block_inverse  H y and H P g_new by blocks, which share no variable; written over the old
 *           values or, with `more`, added to them; launch: (WG n blocks,), a group a block, on
 *           the first axis because GPUs limit the groups along other axes
 *
 * Directions d of few variables add d d^T to these inverses, a variable's terms in their order.
 * A run is variables side by side in the same directions.
 *   owner     (m,) int: the scene of each direction;  totals (m, 2): d . y and d . P g_new
 * direction_products  totals, 0 of idle scenes; ends (m + 1,) int: first of each direction's
 *           elements, then the number of all;  places (k,) int and d (k,): the elements' variables
 *           and values;  launch: (WG m,), a group a direction
 * add_directions  the directions' terms added to H y and H P g_new, run by run:
 *           runs (n + 1, 4) int: first variable, number of variables, first of `of`, first of
 *           `values`, and after the last run the ends;  of (k,) int: the directions of each run;
 *           values: of a run's variables, direction by direction;  launch: (LANES n,) at least
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"
#ifndef MAX_BLOCK        /* variables of a block, at most; a multiple of PANEL */
#define MAX_BLOCK 512
#endif
#ifndef PANEL       /* rows of a root that have one length; SUM8 is for 8 */
#define PANEL 8
#endif
#ifndef LANES       /* work-items of a run */
#define LANES 1
#endif
#define REST 0

/* The first row of a panel, of rows as long as its last one: i, a multiple of PANEL. */
#define ROW(i) (root + (size_t)PANEL * PANEL * ((i) / PANEL) * ((i) / PANEL + 1) / 2)
#define COLUMNS (WG / PANEL)    /* work-items of a row; WG is a multiple of PANEL, but for ROWS */

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void apply_block_inverse(__global const int *restrict blocks, __global const int *restrict indices,
            __global const REAL *restrict roots, __global const int *restrict plan,
            const ulong size, const int more, __global const REAL *restrict y,
            __global const REAL *restrict projected, __global REAL *restrict ring_hy,
            __global REAL *restrict hg_new)
{
    __local REAL ys[MAX_BLOCK], ps[MAX_BLOCK];
#if ROWS
    __local REAL wy[MAX_BLOCK], wp[MAX_BLOCK];
#else
    __local REAL row_y[WG], row_p[WG];
#endif
    const int lid = (int)get_local_id(0), block = (int)get_group_id(0);
    /* an idle scene has no variables here: PoCL crashes if a group returns before this SYNC */
    const int b = blocks[4 * block], m = plan[3 * b] == REST ? 0 : blocks[4 * block + 1];
    __global const int *index = indices + blocks[4 * block + 2];
    __global const REAL *root = roots + (size_t)blocks[4 * block + 3] * ALIGN;
    __global REAL *hy = ring_hy + plan[3 * b + 2] * (size_t)size;
    const int n = (m + PANEL - 1) / PANEL * PANEL;
    for (int k = lid; k < n; k += WG) {
        ys[k] = k < m ? y[index[k]] : 0;
        ps[k] = k < m ? projected[index[k]] : 0;
    }
    SYNC();
#if ROWS
    for (int k = 0; k < n; ++k) wy[k] = wp[k] = 0;
    for (int i = 0; i < n; i += PANEL) {    /* a panel is read once, and stays in the first cache */
        const int length = i + PANEL;
        __global const REAL *panel = ROW(i);
        REAL of_y[PANEL], of_p[PANEL];
        for (int r = 0; r < PANEL; r += 4) {
            __global const REAL *r0 = panel + r * length, *r1 = r0 + length;
            __global const REAL *r2 = r1 + length, *r3 = r2 + length;
            REAL y0[PANEL], y1[PANEL], y2[PANEL], y3[PANEL];
            REAL p0[PANEL], p1[PANEL], p2[PANEL], p3[PANEL];
            for (int l = 0; l < PANEL; ++l)
                y0[l] = y1[l] = y2[l] = y3[l] = p0[l] = p1[l] = p2[l] = p3[l] = 0;
            for (int k = 0; k < length; k += PANEL) {
                for (int l = 0; l < PANEL; ++l) y0[l] += r0[k + l] * ys[k + l];
                for (int l = 0; l < PANEL; ++l) p0[l] += r0[k + l] * ps[k + l];
                for (int l = 0; l < PANEL; ++l) y1[l] += r1[k + l] * ys[k + l];
                for (int l = 0; l < PANEL; ++l) p1[l] += r1[k + l] * ps[k + l];
                for (int l = 0; l < PANEL; ++l) y2[l] += r2[k + l] * ys[k + l];
                for (int l = 0; l < PANEL; ++l) p2[l] += r2[k + l] * ps[k + l];
                for (int l = 0; l < PANEL; ++l) y3[l] += r3[k + l] * ys[k + l];
                for (int l = 0; l < PANEL; ++l) p3[l] += r3[k + l] * ps[k + l];
            }
            of_y[r] = SUM8(y0);
            of_y[r + 1] = SUM8(y1);
            of_y[r + 2] = SUM8(y2);
            of_y[r + 3] = SUM8(y3);
            of_p[r] = SUM8(p0);
            of_p[r + 1] = SUM8(p1);
            of_p[r + 2] = SUM8(p2);
            of_p[r + 3] = SUM8(p3);
        }
        for (int k = 0; k < length; k += PANEL) {
            REAL sum_y[PANEL], sum_p[PANEL];
            for (int l = 0; l < PANEL; ++l) {
                sum_y[l] = wy[k + l];
                sum_p[l] = wp[k + l];
            }
            for (int r = 0; r < PANEL; ++r)
                for (int l = 0; l < PANEL; ++l) {
                    sum_y[l] += panel[r * length + k + l] * of_y[r];
                    sum_p[l] += panel[r * length + k + l] * of_p[r];
                }
            for (int l = 0; l < PANEL; ++l) {
                wy[k + l] = sum_y[l];
                wp[k + l] = sum_p[l];
            }
        }
    }
    for (int k = 0; k < m; ++k) {
        hy[index[k]] = more ? hy[index[k]] + wy[k] : wy[k];
        hg_new[index[k]] = more ? hg_new[index[k]] + wp[k] : wp[k];
    }
#else
    /* The rows of a panel side by side, with COLUMNS work-items each, which read adjacent values.
     * The panel is read again for its columns, while it is in a cache: every WG-th of them. */
    const int row = lid / COLUMNS, column = lid % COLUMNS;
    REAL sum_y[MAX_BLOCK / WG], sum_p[MAX_BLOCK / WG];
    for (int q = 0; q < MAX_BLOCK / WG; ++q) sum_y[q] = sum_p[q] = 0;
    __global const REAL *panel = root;
    for (int length = PANEL; length <= n; panel += PANEL * length, length += PANEL) {
        __global const REAL *mine = panel + row * length;
        REAL of_y = 0, of_p = 0;
        for (int k = column; k < length; k += COLUMNS) {
            of_y += mine[k] * ys[k];
            of_p += mine[k] * ps[k];
        }
        SYNC();                             /* the sums of the panel before have been read */
        row_y[lid] = of_y;
        row_p[lid] = of_p;
        for (int apart = COLUMNS / 2; apart > 0; apart /= 2) {
            SYNC();
            if (column < apart) {
                row_y[lid] += row_y[lid + apart];
                row_p[lid] += row_p[lid + apart];
            }
        }
        SYNC();
        for (int q = 0; q < MAX_BLOCK / WG; ++q) {
            const int k = lid + q * WG;
            if (k < length)
                for (int r = 0; r < PANEL; ++r) {
                    const REAL value = panel[r * length + k];
                    sum_y[q] += value * row_y[r * COLUMNS];
                    sum_p[q] += value * row_p[r * COLUMNS];
                }
        }
    }
    for (int q = 0; q < MAX_BLOCK / WG; ++q) {
        const int k = lid + q * WG;
        if (k >= m) continue;
        hy[index[k]] = more ? hy[index[k]] + sum_y[q] : sum_y[q];
        hg_new[index[k]] = more ? hg_new[index[k]] + sum_p[q] : sum_p[q];
    }
#endif
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void direction_products(__global const int *restrict owner, __global const int *restrict ends,
            __global const int *restrict places, __global const REAL *restrict d,
            __global const int *restrict plan, __global const REAL *restrict y,
            __global const REAL *restrict projected, __global REAL *restrict totals)
{
    __local REAL share[2 * WG];
    const int lid = (int)get_local_id(0), k = (int)get_group_id(0);
    /* idle scenes: none, as above */
    const int end = plan[3 * owner[k]] == REST ? 0 : ends[k + 1];
    REAL total[2] = {0, 0};
    for (int i = ends[k] + lid; i < end; i += WG) {
        total[0] += d[i] * y[places[i]];
        total[1] += d[i] * projected[places[i]];
    }
    GROUP_SUMS(total, 2, lid, share)
    if (lid == 0) {
        totals[2 * k] = total[0];
        totals[2 * k + 1] = total[1];
    }
}

__kernel void add_directions(__global const int *restrict runs, __global const int *restrict of,
            __global const REAL *restrict values, __global const int *restrict owner,
            __global const int *restrict plan, const ulong size, const int n,
            __global const REAL *restrict totals, __global REAL *restrict ring_hy,
            __global REAL *restrict hg_new)
{
    const int i = (int)get_global_id(0) / LANES, lane = (int)get_global_id(0) % LANES;
    if (i >= n) return;
    __global const int *run = runs + 4 * i;
    const int m = run[1], end = run[6], b = owner[of[run[2]]];
    if (plan[3 * b] == REST) return;
    __global const REAL *d = values + run[3];
    __global REAL *hy = ring_hy + plan[3 * b + 2] * (size_t)size + run[0], *hg = hg_new + run[0];
    for (int k = run[2]; k < end; ++k, d += m) {
        const REAL total_y = totals[2 * of[k]], total_p = totals[2 * of[k] + 1];
        for (int j = lane; j < m; j += LANES) {
            hy[j] += d[j] * total_y;
            hg[j] += d[j] * total_p;
        }
    }
}
