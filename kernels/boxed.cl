/* Products of the sources' boxes with shared tables: one product for each source, with its own
 * sizes and positions.
 *
 *   C[s] = A[s] . B[s],  A (m, k), B (k, n), C (m, n), for the sources listed in `active`
 *
 * items (S, N_COLUMNS) long, one row a source with the columns below: sizes; first elements of A, B
 * and C in their buffers; distances [elements] of A's rows and columns, of B's rows, and of C's
 * rows and columns.
 *   B is read as vectors: its start and LD_B are multiples of 16 elements.  The first SKIP columns
 *      are computed but not stored.
 *   C is stored by vectors, up to a multiple of 16 columns, where B's zeros give zeros; its first
 *      element and its rows are aligned like B's, and SKIP is 0.  If RAGGED, C is stored element by
 *      element, n in a row; then `add` adds to the present values.
 *
 * A work-item owns MR rows and NV vectors of VW columns of C at a time, in registers, and adds
 * partial sums of `block` terms in the order `inward`, see contract.cl.
 *
 * Launch: (any number of work-items, which share the columns, ceil(most rows / MR), len(active)),
 * each rounded up to its local size.  On CPUs one work-item computes all columns, because a tile of
 * a small box takes no longer than the start of a work-item.
 */
#if ON_CPU          /* one build for both, see contract.h */
#define RAGGED ragged
#endif
#include "contract.h"

enum { M, N, K, BEGIN_A, LD_A, NEXT_A, BEGIN_B, LD_B, SKIP, BEGIN_C, LD_C, NEXT_C, N_COLUMNS };

__kernel __attribute__((reqd_work_group_size(WGX, WGY, 1)))
void multiply_boxes(__global const int *restrict active, __global const long *restrict items,
           const int block, const int inward, __global const REAL *restrict A,
           __global const REAL *restrict B, __global REAL *restrict C, const int ragged,
           const int add)
{
    __global const long *item = items + (size_t)N_COLUMNS * active[get_global_id(2)];
    const int m = (int)item[M], k = (int)item[K], skip = (int)item[SKIP];
    const int end = skip + (int)item[N], n_pad = (end + 15) / 16 * 16;
    const int i0 = (int)get_global_id(1) * MR, ld_b = (int)item[LD_B];
    if (i0 >= m) return;
    A += item[BEGIN_A];
    B += item[BEGIN_B];
    C += item[BEGIN_C];
#if STRIDED
    const long step_a = item[NEXT_A];
#endif
    __global const REAL *row[MR];
    UNROLL(i, MR) row[i] = A + (size_t)(i0 + i < m ? i0 + i : m - 1) * (size_t)item[LD_A];

    for (int j0 = (int)get_global_id(0) * NV * VW; j0 < n_pad;
         j0 += (int)get_global_size(0) * NV * VW) {
        int column[NV];
        WIDE acc[MR][NV];
        UNROLL(v, NV) column[v] = j0 + v * VW < n_pad ? j0 + v * VW : j0;
        SUM_INSIDE(n_pad - j0, MR, acc, row, B, ld_b, column, k, block, inward)
        HOLD_SUMS
        EACH(i, MR) EACH(v, NV) {
            if (i0 + i >= m || j0 + v * VW >= n_pad) continue;
            __global REAL *c = C + (size_t)(i0 + i) * (size_t)item[LD_C];
            if (!RAGGED) {
                AT(WIDE, c + column[v]) = SUMS[i][v];
                continue;
            }
            const REAL *lane = (const REAL *)&SUMS[i][v];
            for (int j = 0; j < VW; ++j) {
                const int x = j0 + v * VW + j;
                if (x < skip || x >= end) continue;
                __global REAL *to = c + (size_t)(x - skip) * (size_t)item[NEXT_C];
                *to = add ? *to + lane[j] : lane[j];
            }
        }
    }
}
