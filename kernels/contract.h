/* Common parts of contract.cl, boxed.cl, contract_group.cl and mirror.h: their sizes, vectors of
 * VW, and the sums of a tile in registers.
 *
 * Order of the terms: the smallest first, so that rounding errors are those of small sums.
 *   inward 1   for sums over pixels, whose light is brightest in the middle: partial sums from both
 *              ends in turn, each from its end towards the middle
 *   inward 0   for sums over frequencies, whose terms decrease: from the last term to the first
 */
#include "common.h"
#include "transfer.h"

#ifndef VW          /* columns of a vector */
#define VW 16
#endif
#ifndef NV          /* vectors a work-item owns in each row */
#define NV 1
#endif
#ifndef MR          /* rows a work-item owns; even, so that (cos, sin) pairs stay together */
#define MR 6
#endif
#ifndef WGX         /* work-items of a group along the columns of C */
#define WGX 1
#endif
#ifndef WGY         /* work-items of a group along the rows of C */
#define WGY 1
#endif
#ifndef STRIDED     /* 1: A's columns lie step_a apart; 0: they are adjacent, step_a is not read */
#define STRIDED 0
#endif
#ifndef RAGGED      /* 1: C is a caller's array, stored element by element; 0: padded, by vectors */
#define RAGGED 0
#endif
/* ON_CPU: a tile's sums are copied to memory once they are complete, and a loop over them follows;
 * epilogues, OWN and RAGGED are arguments. So few and small builds serve all products: with
 * everything unrolled, and a build for each product, a first fit compiled for 18 core-seconds, now
 * for 8. */
#ifndef ON_CPU      /* 1: as said above; 0: for GPUs, whose sums stay in registers */
#define ON_CPU 0
#endif
#if ON_CPU
#define MIX (epilogue == 1)
#define TWIST (epilogue == 2)
#define SIGN sign
#define OWN (own != 0)
#define SUMS held
#define EACH ROLL
#define HOLD_SUMS WIDE held[MR][NV]; UNROLL(i, MR) UNROLL(v, NV) held[i][v] = acc[i][v];
#else
#define SUMS acc
#define EACH UNROLL
#define HOLD_SUMS
#endif
#ifndef MIX         /* 1: multiply by the transfer function */
#define MIX 0
#endif
#ifndef TWIST       /* 1: rotate (cos, sin) row pairs */
#define TWIST 0
#endif
#ifndef SIGN        /* of MIX's or TWIST's angles: 1 forward, -1 adjoint */
#define SIGN 1
#endif
#ifndef OWN         /* 1: items have sizes and tables of their own, see contract.cl */
#define OWN 0
#endif

#ifndef KU          /* terms of one iteration: with 1, loop overhead takes 6 % of the time */
#define KU 4
#endif
#ifndef PREFETCH_B  /* prefetch for the terms of an iteration, which begin at `from` in B */
#define PREFETCH_B(from, step)
#endif
#ifndef AHEAD_LEFT  /* prefetch for the n terms of a partial sum from l on, in the rows of A */
#define AHEAD_LEFT(row, l, step, n)
#endif

/* Sizes of item b, and the table of a factor. */
#define TAKE_OWN \
    const int table = OWN ? which[b / n_bands] : b / n_bands; \
    if (OWN) { \
        m = own[3 * table]; \
        n = own[3 * table + 1]; \
        k = own[3 * table + 2]; \
    }
#define TABLE(div) (size_t)(OWN && (div) == 0 ? table : b / (div))

/* Address of plane q of the epilogue's tables for an item's row pair h and column j. */
#define PLANES (MIX ? 4 : 2)
#define BAND_E (MIX ? (size_t)(b % n_bands) * band_e : 0)
#define PLANE(h, q, j) \
    (E + (size_t)table * stride_e + BAND_E + (size_t)(i0 / 2 + (h)) * 2 * n_pad \
     + (q) * (2 * n_pad / PLANES) + (j) * 2 / PLANES)

#define WIDE VEC(VW)
#if VW == 16
#define HALF VEC(8)
#define EVEN(v) (v).s02468ace
#define ODD(v) (v).s13579bdf
#elif VW == 8
#define HALF VEC(4)
#define EVEN(v) (v).s0246
#define ODD(v) (v).s1357
#elif VW == 4
#define HALF VEC(2)
#define EVEN(v) (v).s02
#define ODD(v) (v).s13
#else
#define HALF REAL
#define EVEN(v) (v).s0
#define ODD(v) (v).s1
#endif

#if STRIDED
#define STEP_A (size_t)step_a
#else
#define STEP_A 1
#endif

/* part[mr][nv] += row[i][l STEP_A] times the vectors at from + column[v], nv of them. */
#define ADD_TERM(mr, nv, l, row, from, column) \
    UNROLL(v, nv) right[v] = AT(const WIDE, (from) + column[v]); \
    UNROLL(i, mr) UNROLL(v, nv) part[i][v] += row[i][(l) * STEP_A] * right[v];

/* sums[mr][nv] += the next partial sum of `block` terms, or of the remaining ones, ku an iteration.
 * It begins at term l, whose row of B is at `from`, and goes upwards or downwards for `step` 1 or
 * -1. l and `from` are advanced to the next partial sum of that direction: recomputing them would
 * take 6 % of the time. */
#define ADD_STRETCH(mr, nv, ku, sums, row, l, step, from, ld_b, column, block) { \
        int n_terms = remain < (block) ? remain : (block); \
        WIDE part[mr][nv], right[nv]; \
        UNROLL(i, mr) UNROLL(v, nv) part[i][v] = (WIDE)(0); \
        remain -= n_terms; \
        AHEAD_LEFT(row, l, step, n_terms) \
        if (ku > 1) for (; n_terms >= ku; n_terms -= ku) { \
            PREFETCH_B(from, step) \
            UNROLL(u, ku) { \
                ADD_TERM(mr, nv, l + (step) * u, row, from + (step) * u * (long)(ld_b), column) \
            } \
            l += (step) * ku; \
            from += (step) * ku * (long)(ld_b); \
        } \
        for (; n_terms > 0; --n_terms) { \
            ADD_TERM(mr, nv, l, row, from, column) \
            l += (step); \
            from += (step) * (long)(ld_b); \
        } \
        UNROLL(i, mr) UNROLL(v, nv) sums[i][v] += part[i][v]; \
    }

/* sums[mr][nv] = the terms l < k, in partial sums of `block` and in the order above. Each direction
 * has its own loop: a loop with a variable step takes 4 % longer. */
#define SUM_TERMS(mr, nv, ku, sums, row, B, ld_b, column, k, block, inward) { \
        int remain = (k); \
        long up = 0, down = (k) - 1; \
        __global const REAL *from_up = (B), *from_down = (B) + down * (ld_b); \
        UNROLL(i, mr) UNROLL(v, nv) sums[i][v] = (WIDE)(0); \
        while (remain > 0) { \
            if (inward) \
                ADD_STRETCH(mr, nv, ku, sums, row, up, 1, from_up, ld_b, column, block) \
            ADD_STRETCH(mr, nv, ku, sums, row, down, -1, from_down, ld_b, column, block) \
        } \
    }

/* The same for a tile of MR rows and NV vectors, whose columns from `inside` on and rows from
 * `below` on are not needed. If only one vector is inside, in the last tile of a row, only that one
 * is summed, and the others are zero. If only two rows are inside, in the last tile of a column,
 * only these are summed, and the others are not written. Both cases add two terms an iteration:
 * with KU, they took half of the compile time. */
#define SUM_INSIDE(inside, below, sums, row, B, ld_b, column, k, block, inward) \
    if (NV > 1 && (inside) <= VW) { \
        UNROLL(i, MR) UNROLL(v, NV) sums[i][v] = (WIDE)(0); \
        SUM_TERMS(MR, 1, 1, sums, row, B, ld_b, column, k, block, inward) \
    } else if (MR > 2 && (below) <= 2) { \
        SUM_TERMS(2, NV, 1, sums, row, B, ld_b, column, k, block, inward) \
    } else { \
        SUM_TERMS(MR, NV, KU, sums, row, B, ld_b, column, k, block, inward) \
    }
