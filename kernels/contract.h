/* What the kernels of contract.cl and contract_group.cl share: their sizes, and vectors of VW. */
#include "common.h"

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
#ifndef MIX         /* 1: multiply by the transfer function */
#define MIX 0
#endif
#ifndef TWIST       /* 1: rotate (cos, sin) row pairs */
#define TWIST 0
#endif
#ifndef SIGN        /* of MIX's or TWIST's angles: 1 forward, -1 adjoint */
#define SIGN 1
#endif

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

#define UNROLL(i, n) _Pragma("unroll") for (int i = 0; i < (n); ++i)
