/* Tiled matrix contraction, with the point-wise stages of the resampling operator folded in.
 *
 *   C[b] = A[b] . B[b],  A (m, k), B (k, n), C (m, n), row-major
 *
 *                                   NV VW
 *                              +----+----+-------+
 *                              |    |    |       |
 *                            k |    | B  |       |     row stride n_pad
 *                              |    |    |       |
 *               k              +----+----+-------+
 *          +---------+         +----+----+-------+
 *          |         |         |    |    |       |
 *       MR +---------+      MR +----#====#       |     one work-item owns this tile of C:
 *          |    A    |         |    #    #       |     MR rows, NV vectors of VW columns
 *          +---------+         +----#====#       |
 *        m |         |       m |                 |     n_pad, or any if RAGGED
 *          +---------+         +-----------------+
 *                                n in whole vectors
 *
 * The tile is in registers: B is read as aligned vectors, A as scalars that are broadcast.  There
 * is no local memory, no barrier, and no builtin but that of READ_AHEAD.  A work-item computes RT
 * such tiles, one below the other.
 *
 * Layout: `width` = n rounded up to a multiple of 16, and so to whole vectors.  If a tile extends
 *   beyond it, the vectors there repeat the work of the first one.  Rows of B are n_pad >= width
 *   apart, with zeros from n to width; so are those of C, unless RAGGED, when C is a caller's
 *   array: element (i, j) at i * ld_c + j * step_c, any alignment.  Nothing beyond width is read or
 *   written.  A is any array: element (i, l) at i * ld_a + l, or at i * ld_a + l * step_a if
 *   STRIDED, so that it may be read transposed.
 * Batch: item b uses A + (b / div_a) * stride_a, and B correspondingly, so that a table shared by
 *   all bands of a scene has div = n_bands, one shared by all scenes has stride 0.
 * Terms are added in partial sums of `block` terms, and these in a second set of registers: the
 *   rounding error then grows with the root of block + k / block, not of k.  Their order: `inward`,
 *   see contract.h.
 * READ_AHEAD: prefetches memory during the multiplication:
 *   B: the columns of the next work-item, into the core's second cache, one row of KU for each
 *      tile, since its elements are a row of B apart.  After the last columns, the first columns of
 *      the next item.
 *   A: the rows of the tile below, one partial sum at a time, by the work-item of the first columns
 *   C, E: the elements that the tile itself writes and reads
 * Rows beyond m read row m - 1 again and are not stored.
 *
 * Epilogue, at most one of (rows 2i, 2i+1 are the cos and sin parts of row frequency i):
 *   MIX    multiplies by the transfer function D, see transfer.h.  Columns 2j, 2j+1 are cos and sin
 *          of column frequency j; with two rows they form a quad.  E: D
 *          (n_bands, k_y, 4, n_pad / 2), planes Re D(+,+), Im D(+,+), Re D(+,-), Im D(+,-).
 *          SIGN -1 conjugates D: the adjoint.
 *   TWIST  rotates each (cos, sin) row pair by the angle of E: (k_y, 2, n_pad), planes cos and sin.
 *          SIGN -1 turns the other way: the adjoint.
 *   E of item b starts at (b / n_bands) * stride_e + (b % n_bands) * band_e.
 * OWN: items have sizes and tables of their own, b those of t = which[b / n_bands]: own (tables, 3)
 *   are m, n and k, none larger than the arguments, which determine the layout. Elements of C
 *   beyond them are not written. A factor with div 0, and E, are those of t.
 *
 * Launch: global = (ceil(width / (NV VW)), ceil(m / (MR RT)), batch), each rounded up to its
 *   local size.
 */
#define ON_CPU 1
#define RAGGED ragged       /* one build for both, see contract.h */
#include "prefetch.h"
#if READ_AHEAD
#define PREFETCH_B(from, step) PREFETCH((from) + next + (step) * skipped, 0, 2)
#if !STRIDED        /* adjacent rows, the usual case */
#define AHEAD_LEFT(row, l, step, n) \
    if (j0 == 0) _Pragma("nounroll") for (int q = 0; q < (n) * MR; q += LINE) \
        PREFETCH(row[0] + (long)MR * ld_a + (l) * MR + (step) * q, 0, 3)
#endif
#endif
#include "contract.h"

#ifndef RT          /* tiles that a work-item owns, one below the other */
#define RT 1
#endif
#define OWNED(i, v) (i0 + (i) < m && j0 + (v) * VW < width)
/* By the vector's address, so that on CPUs the vector is stored at once, and for adjacent columns
 * also to C. With a test for each lane the store would take a third of the product's time. */
#define STORE_LANES(sums, c, n_left) \
    const REAL *lane = (const REAL *)&sums; \
    if (step_c == 1 && n_left >= VW) { \
        UNROLL(j, VW) c[j] = lane[j]; \
    } else { \
        for (int j = 0; j < VW; ++j) \
            if (j < n_left) c[(size_t)j * step_c] = lane[j]; \
    }

__kernel __attribute__((reqd_work_group_size(WGX, WGY, 1)))
void contract(int m, int n, const int n_pad, int k, const int block,
              const int inward,
              __global const REAL *restrict A, const ulong offset_a, const int ld_a,
              const int step_a, const int stride_a, const int div_a,
              __global const REAL *restrict B, const int stride_b, const int div_b,
              __global REAL *restrict C, const ulong offset_c, const int ld_c, const int step_c,
              const int stride_c,
              __global const REAL *restrict E, const int stride_e, const int band_e,
              const int n_bands, const int epilogue, const int sign, const int ragged,
              __global const int *restrict which, __global const int *restrict own)
{
    const int j0 = (int)get_global_id(0) * NV * VW;
    const int top = (int)get_global_id(1) * MR * RT;
    const int b = (int)get_global_id(2);
    TAKE_OWN
    const int width = (n + 15) / 16 * 16;
    if (j0 >= width || top >= m) return;
    A += offset_a + TABLE(div_a) * stride_a;
    B += TABLE(div_b) * stride_b;
    C += offset_c + (size_t)b * stride_c;

    int column[NV];
    UNROLL(v, NV) column[v] = j0 + v * VW < width ? j0 + v * VW : j0;
    const int terms = j0 < n ? k : 0;           /* beyond n all sums are zero */
    const int bottom = m - top < MR * RT ? m : top + MR * RT;
#if READ_AHEAD
    const long next = j0 + NV * VW < width ? j0 + NV * VW : stride_b;
#endif
    for (int i0 = top; i0 < bottom; i0 += MR) {
        __global const REAL *row[MR];
        WIDE acc[MR][NV];
#if READ_AHEAD
        const long skipped = (i0 - top) / MR % KU * (long)n_pad;
        if (!RAGGED || step_c == 1)
            ROLL(i, MR) for (int j = j0; j < j0 + NV * VW; j += LINE)
                PREFETCH(C + (size_t)(i0 + i) * ld_c + j, 1, 3)
        if (MIX || TWIST)
            ROLL(h, MR / 2) ROLL(q, PLANES) for (int j = j0; j < j0 + NV * VW; j += LINE)
                PREFETCH(PLANE(h, q, j), 0, 3)
#endif
        UNROLL(i, MR) row[i] = A + (size_t)(i0 + i < m ? i0 + i : m - 1) * ld_a;
        SUM_INSIDE(n - j0, m - i0, acc, row, B, n_pad, column, terms, block, inward)
        HOLD_SUMS
#include "contract_epilogue.h"
    }
}
