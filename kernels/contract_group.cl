/* The contraction of contract.cl for GPUs: a group of work-items shares slabs of A and B.
 *
 *   C[b] = A[b] . B[b],  all arguments, layouts, batches and epilogues as in contract.cl
 *
 *                                        TN = WGX NV VW
 *                                     +-------+------------+
 *                                  KB | slab  |            |     in local memory, two of each:
 *                                     +-------+    B       |     one is multiplied while the
 *                                   k |       |            |     next is fetched
 *               KB      k             +-------+------------+
 *             +----+---------+        +-------+------------+
 *   TM =      |slab|    A    |        | tile  |            |     one group owns this tile of C
 *   WGY MR    +----+---------+        +-------+    C       |
 *           m |              |      m |                    |
 *
 * A work-item owns MR neighbouring rows, and NV vectors of VW columns that lie WGX VW apart, so
 * that neighbours read neighbouring vectors. A's slab is transposed: the rows of a work-item are
 * read at once, and are the same for all work-items of a row of the group.
 *
 * Sums: one set of registers for all k terms, slab by slab: the last one first, or from both ends
 *   in turn if `inward`, see contract.h; within a slab from the last term down. With TWO_SUMS there
 *   are partial sums of `block` terms, rounded up to whole slabs. Elements beyond k or m count as
 *   zero.
 *
 * Launch: global = (ceil(width / TN) WGX, ceil(m / TM) WGY, batch), groups of (WGX, WGY, 1).
 */
#include "contract.h"

#ifndef KB          /* terms of a slab: a multiple of WGX and of WGY */
#define KB 16
#endif
#ifndef TWO_SUMS    /* 1: sum stretches of `block` terms first: more registers, less rounding */
#define TWO_SUMS 0
#endif

/* If unrolled, the next terms are fetched while one is multiplied. With two sums, or in double
 * precision, there are not enough registers for them. */
#if TWO_SUMS || defined(USE_DOUBLE)
#define EACH_TERM(l) for (int l = KB - 1; l >= 0; --l)
#else
#define EACH_TERM(l) _Pragma("unroll") for (int l = KB - 1; l >= 0; --l)
#endif

#define GROUP (WGX * WGY)
#define TM (WGY * MR)
#define VECTORS (WGX * NV)                   /* vectors of a row of B's slab */
#define LD (TM + 4)                          /* elements of a column of A's slab */
#define FETCH_A (TM * KB / GROUP)            /* elements of A's slab that a work-item fetches */
#define FETCH_B (VECTORS * KB / GROUP)       /* vectors of B's slab, likewise */
#if MR % 4 == 0
#define ROWS_AT_ONCE 4
#else
#define ROWS_AT_ONCE 2
#endif
#define LEFT VEC(ROWS_AT_ONCE)
#define OWNED(i, v) (i0 + (i) < m && column[v] < width)

/* Lane by lane: taking an address would make a GPU keep all sums in memory. OpenCL C has no macros
 * of variable numbers of arguments, and NVIDIA's driver refuses them. */
#define STORE(j, lane, sums, c, n_left) if (j < n_left) c[(size_t)j * step_c] = sums.lane;
#define STORE_2(sums, c, n_left) STORE(0, s0, sums, c, n_left) STORE(1, s1, sums, c, n_left)
#define STORE_4(sums, c, n_left) \
    STORE_2(sums, c, n_left) STORE(2, s2, sums, c, n_left) STORE(3, s3, sums, c, n_left)
#define STORE_8(sums, c, n_left) \
    STORE_4(sums, c, n_left) STORE(4, s4, sums, c, n_left) STORE(5, s5, sums, c, n_left) \
    STORE(6, s6, sums, c, n_left) STORE(7, s7, sums, c, n_left)
#define STORE_PASTE(n) STORE_##n
#define STORE_EXPAND(n) STORE_PASTE(n)
#define STORE_LANES STORE_EXPAND(VW)

/* Neighbouring work-items fetch neighbouring elements of A: along its rows, or down its columns
 * where it is read transposed. */
#if STRIDED
#define SLAB_ROW(t) ((t) % TM)
#define SLAB_TERM(t) ((t) / TM)
#else
#define SLAB_ROW(t) ((t) / KB)
#define SLAB_TERM(t) ((t) % KB)
#endif

/* First term of the present slab. */
#define SLAB(turn) \
    (KB * (!inward ? n_slabs - 1 - (turn) \
           : (turn) % 2 == 0 ? (turn) / 2 : n_slabs - 1 - (turn) / 2))

#define FETCH(l0) \
    UNROLL(f, FETCH_A) { \
        const int t = f * GROUP + lid, i = top + SLAB_ROW(t), l = (l0) + SLAB_TERM(t); \
        next_a[f] = i < m && l < k ? A[(size_t)i * ld_a + (size_t)l * STEP_A] : (REAL)0; \
    } \
    UNROLL(f, FETCH_B) { \
        const int t = f * GROUP + lid, l = (l0) + t / VECTORS; \
        const int j = first + t % VECTORS * VW; \
        next_b[f] = l < k && j < width ? AT(const WIDE, B + (size_t)l * n_pad + j) : (WIDE)(0); \
    }

__kernel __attribute__((reqd_work_group_size(WGX, WGY, 1)))
void contract_group(int m, int n, const int n_pad, int k,
                    const int block, const int inward,
                    __global const REAL *restrict A, const ulong offset_a, const int ld_a,
                    const int step_a, const int stride_a, const int div_a,
                    __global const REAL *restrict B, const int stride_b, const int div_b,
                    __global REAL *restrict C, const ulong offset_c, const int ld_c,
                    const int step_c,
                    const int stride_c,
                    __global const REAL *restrict E, const int stride_e, const int band_e,
                    const int n_bands,
                    __global const int *restrict which, __global const int *restrict own)
{
    __local REAL slab_a[2][KB][LD] __attribute__((aligned(32)));
    __local WIDE slab_b[2][KB][VECTORS];
    const int lx = (int)get_local_id(0), ly = (int)get_local_id(1), lid = ly * WGX + lx;
    const int top = (int)get_group_id(1) * TM, first = (int)get_group_id(0) * VECTORS * VW;
    const int i0 = top + ly * MR, b = (int)get_global_id(2);
    TAKE_OWN
    const int width = (n + 15) / 16 * 16;
    if (top >= m || first >= width) return;   /* all of a group */
    A += offset_a + TABLE(div_a) * stride_a;
    B += TABLE(div_b) * stride_b;
    C += offset_c + (size_t)b * stride_c;

    REAL next_a[FETCH_A];
    WIDE next_b[FETCH_B], acc[MR][NV];
    int column[NV];
    UNROLL(v, NV) column[v] = first + (v * WGX + lx) * VW;
    UNROLL(i, MR) UNROLL(v, NV) acc[i][v] = (WIDE)(0);
#if TWO_SUMS
    WIDE part[MR][NV];
    int terms = 0;
    UNROLL(i, MR) UNROLL(v, NV) part[i][v] = (WIDE)(0);
#define SUM part
#else
#define SUM acc
#endif
    const int n_slabs = (k + KB - 1) / KB;
    FETCH(SLAB(0))
    for (int turn = 0, slab = 0; turn < n_slabs; ++turn, slab ^= 1) {
        UNROLL(f, FETCH_A) {
            const int t = f * GROUP + lid;
            slab_a[slab][SLAB_TERM(t)][SLAB_ROW(t)] = next_a[f];
        }
        UNROLL(f, FETCH_B) {
            const int t = f * GROUP + lid;
            slab_b[slab][t / VECTORS][t % VECTORS] = next_b[f];
        }
        /* One barrier a slab suffices: this slab is overwritten only after the next barrier, which
         * all work-items reach after they have read it. */
        barrier(CLK_LOCAL_MEM_FENCE);
        if (turn + 1 < n_slabs) {
            FETCH(SLAB(turn + 1))
        }
        EACH_TERM(l) {
            WIDE right[NV];
            REAL left[MR];
            UNROLL(v, NV) right[v] = slab_b[slab][l][v * WGX + lx];
            UNROLL(h, MR / ROWS_AT_ONCE) {
                const LEFT some =
                    *(__local const LEFT *)&slab_a[slab][l][ly * MR + h * ROWS_AT_ONCE];
                left[ROWS_AT_ONCE * h] = some.s0;
                left[ROWS_AT_ONCE * h + 1] = some.s1;
#if MR % 4 == 0
                left[4 * h + 2] = some.s2;
                left[4 * h + 3] = some.s3;
#endif
            }
            UNROLL(i, MR) UNROLL(v, NV) SUM[i][v] += left[i] * right[v];
        }
#if TWO_SUMS
        terms += KB;
        if (terms >= block || turn + 1 == n_slabs) {
            UNROLL(i, MR) UNROLL(v, NV) {
                acc[i][v] += part[i][v];
                part[i][v] = (WIDE)(0);
            }
            terms = 0;
        }
#endif
    }

#include "contract_epilogue.h"
}
