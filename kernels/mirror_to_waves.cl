/* From pixels to waves, C = W X or X W^T: see mirror.h. */
#include "mirror.h"

#define OWNED(i, v) (i0 + (i) < m && j0 + (v) * VW < width)
#define STORE_LANES(sums, c, n_left)        /* contract_epilogue.h's, if RAGGED: not here */
#if VW == 16
#define IN_TURN(x) (x).s0101010101010101
#elif VW == 8
#define IN_TURN(x) (x).s01010101
#elif VW == 4
#define IN_TURN(x) (x).s0101
#else
#define IN_TURN(x) (x)
#endif
/* add(l) for l < n, ku of them a turn. */
#define FOR_PAIRS(n, ku, add) { \
        int l = 0; \
        if (ku > 1) for (; l + ku <= (n); l += ku) UNROLL(u, ku) { add(l + u) } \
        for (; l < (n); ++l) { add(l) } \
    }

/* A partial sum of pairs of rows or of columns, with sums and differences in `folded`. */
#if SIDE == 0
#define ADD_PAIR(l) UNROLL(i, rows) UNROLL(v, vectors) part[i][v] += row[i][l] * folded[odd][l][v];
#define ADD_PAIRS(mr, nv, ku) { \
    enum { rows = mr, vectors = nv }; \
    WIDE part[mr][nv]; \
    CLEAR(part, mr, nv) \
    FOR_PAIRS(n_here, ku, ADD_PAIR) \
    UNROLL(i, mr) UNROLL(v, nv) sums[odd][i][v] = part[i][v]; \
}
#else
#define ADD_PAIR(l) \
    UNROLL(v, vectors) \
        right[v] = AT(const WIDE, B + (long)(first + (l)) * n_pad + column[v]); \
    UNROLL(i, rows) { \
        const WIDE both = IN_TURN(folded[i0 - top + i][l]); \
        UNROLL(v, vectors) acc[i][v] += both * right[v]; \
    }
#define ADD_PAIRS(mr, nv, ku) { \
        enum { rows = mr, vectors = nv }; \
        WIDE right[nv]; \
        FOR_PAIRS(n_here, ku, ADD_PAIR) \
    }
#endif

__kernel __attribute__((reqd_work_group_size(WGX, WGY, 1)))
void mirror_to_waves(int m, int n, const int n_pad, int k,
           __global const REAL *restrict A, const ulong offset_a, const int ld_a,
           const int step_a, const int stride_a, const int div_a,
           __global const REAL *restrict B, const int stride_b, const int div_b,
           __global REAL *restrict C, const ulong offset_c, const int ld_c, const int step_c,
           const int stride_c,
           __global const REAL *restrict E, const int stride_e, const int band_e,
           const int n_bands, const int epilogue, const int sign,
           __global const int *restrict which, __global const int *restrict own)
{
    int j0 = (int)get_global_id(0) * NV * VW, column[NV];
    const int top = (int)get_global_id(1) * MR * RT;
    const int b = (int)get_global_id(2);
    TAKE_OWN
    const int n_pairs = k / 2, n_sums = n, width = (n + 15) / 16 * 16;
    const int bottom = m - top < MR * RT ? m : top + MR * RT;
    if (j0 >= width || top >= m) return;
#if SIDE == 1
    if (j0 > 0) return;                     /* one work-item computes all columns */
#endif
    A += offset_a + TABLE(div_a) * stride_a;
    B += TABLE(div_b) * stride_b;
    C += offset_c + (size_t)b * stride_c;
    TAKE_NEXT
    TAKE_COLUMNS

#if SIDE == 0
    for (int first = 0; first == 0 || first < n_pairs; first += FOLDED) {
        const int n_here = n_pairs - first < FOLDED ? n_pairs - first : FOLDED;
        const bool is_last = first + FOLDED >= n_pairs;
        __global const REAL *near = B + (long)first * n_pad;
        __global const REAL *far = B + (long)(k - 1 - first) * n_pad;
        WIDE folded[2][FOLDED][NV];
        for (int l = 0; l < n_here; ++l, near += n_pad, far -= n_pad) {
            NEXT_COLUMNS(near + j0)
            NEXT_COLUMNS(far + j0)
            UNROLL(v, NV) {
                const WIDE a = AT(const WIDE, near + column[v]);
                const WIDE z = AT(const WIDE, far + column[v]);
                folded[0][l][v] = a + z;
                folded[1][l][v] = a - z;
            }
        }
        /* two tiles at a time: the rows of both that are cosines, then those that are sines */
        for (int i_two = top; i_two < bottom; i_two += 2 * MR) {
            WIDE sums[2][MR][NV];
            if (NV > 1) ROLL(odd, 2) CLEAR(sums[odd], MR, NV)     /* a vector may be left out */
            ROLL(i, 2 * MR) TO_WRITE(C + (size_t)(i_two + i) * ld_c + j0)
            ROLL(odd, 2) {
                __global const REAL *row[MR];
                UNROLL(i, MR) {
                    const int at = i_two + 2 * i + odd;
                    row[i] = A + (size_t)(at < m ? at : m - 2 + odd) * ld_a + first;
                }
                INSIDE((m - i_two) / 2, ADD_PAIRS)
            }
            for (int i0 = i_two; i0 < i_two + 2 * MR && i0 < bottom; i0 += MR) {
                WIDE held[MR][NV];
                ROLL(i, MR) ROLL(v, NV) {
                    const int at = i0 + i < m ? i0 + i : m - 1;
                    held[i][v] = sums[i % 2][(i0 - i_two + i) / 2][v];
                    if (first > 0) held[i][v] += AT(const WIDE, C + (size_t)at * ld_c + column[v]);
                    if (is_last && k % 2)
                        held[i][v] += A[(size_t)at * ld_a + n_pairs]
                                     * AT(const WIDE, B + (long)n_pairs * n_pad + column[v]);
                }
                if (is_last) {
#include "contract_epilogue.h"
                } else {
                    ROLL(i, MR) ROLL(v, NV) if (OWNED(i, v))
                        AT(WIDE, C + (size_t)(i0 + i) * ld_c + column[v]) = held[i][v];
                }
            }
        }
    }

#else
    for (int first = 0; first == 0 || first < n_pairs; first += FOLDED) {
        const int n_here = n_pairs - first < FOLDED ? n_pairs - first : FOLDED;
        const bool is_last = first + FOLDED >= n_pairs;
        VEC(2) folded[RT * MR][FOLDED];     /* sums and differences, for W^T's columns in turn */
        for (int i = 0; i < bottom - top; ++i) {
            __global const REAL *row = A + (size_t)(top + i) * ld_a;
            for (int l = 0; l < n_here; ++l) {
                const REAL a = row[(first + l) * STEP_A], z = row[(k - 1 - first - l) * STEP_A];
                folded[i][l] = (VEC(2))(a + z, a - z);
            }
        }
        for (j0 = 0; j0 < width; j0 += NV * VW) {
            TAKE_COLUMNS
            for (int i0 = top; i0 < bottom; i0 += MR) {
                WIDE acc[MR][NV];
                CLEAR(acc, MR, NV)
                INSIDE(m - i0, ADD_PAIRS)
                HOLD_SUMS
                ROLL(i, MR) ROLL(v, NV) {
                    if (!OWNED(i, v)) continue;
                    __global REAL *c = C + (size_t)(i0 + i) * ld_c + column[v];
                    if (first > 0) held[i][v] += AT(const WIDE, c);
                    if (is_last && k % 2)
                        held[i][v] += A[(size_t)(i0 + i) * ld_a + n_pairs * STEP_A]
                                     * AT(const WIDE, B + (long)n_pairs * n_pad + column[v]);
                    AT(WIDE, c) = held[i][v];
                }
            }
        }
    }
#endif
}
