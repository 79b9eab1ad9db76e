/* From waves to pixels, C = W^T Z or Z W: see mirror.h. */
#include "mirror.h"

#define PAIRS (MR / 2)                      /* rows of a tile: E and O of each are summed */
#if VW == 16
#define REVERSED(x) (x).sfedcba9876543210
#elif VW == 8
#define REVERSED(x) (x).s76543210
#elif VW == 4
#define REVERSED(x) (x).s3210
#else
#define REVERSED(x) (x).s10
#endif

#if SIDE == 0
#define FETCH_AHEAD NEXT_COLUMNS(from - skipped + j0) NEXT_COLUMNS(from - skipped + n_pad + j0)
#else
#define FETCH_AHEAD
#endif
/* part += the cosines and sines of frequency l, rows `cosines` of B and the next. */
#define ADD_PAIR(mr, nv, l, cosines) \
    UNROLL(v, nv) right[v] = AT(const WIDE, (cosines) + column[v]); \
    UNROLL(i, (mr) / 2) UNROLL(v, nv) part[2 * i][v] += row[i][2 * (l)] * right[v]; \
    UNROLL(v, nv) right[v] = AT(const WIDE, (cosines) + n_pad + column[v]); \
    UNROLL(i, (mr) / 2) UNROLL(v, nv) \
        part[2 * i + 1][v] += row[i][2 * (l) + 1] * right[v];
/* `from` and l decrease together: recomputed for each pair, they take as long as the sums. */
#define ADD_PAIRS(mr, nv, ku) { \
        WIDE part[mr][nv], right[nv]; \
        __global const REAL *from = B + 2 * last * (long)n_pad; \
        int l = last; \
        CLEAR(part, mr, nv) \
        if (ku > 1) for (; l - ku >= first - 1; l -= ku) { \
            FETCH_AHEAD \
            UNROLL(u, ku) { ADD_PAIR(mr, nv, l - u, from - 2 * u * (long)n_pad) } \
            from -= 2 * ku * (long)n_pad; \
        } \
        for (; l >= first; --l) { \
            ADD_PAIR(mr, nv, l, from) \
            from -= 2 * (long)n_pad; \
        } \
        UNROLL(i, mr) UNROLL(v, nv) acc[i][v] += part[i][v]; \
    }

__kernel __attribute__((reqd_work_group_size(WGX, WGY, 1)))
void mirror_to_pixels(int m, int n, const int n_pad, int k,
                __global const REAL *restrict A, const ulong offset_a, const int ld_a,
                const int step_a, const int stride_a, const int div_a,
                __global const REAL *restrict B, const int stride_b, const int div_b,
                __global REAL *restrict C, const ulong offset_c, const int ld_c, const int step_c,
                const int stride_c,
                __global const REAL *restrict E, const int stride_e, const int band_e,
                const int n_bands, const int epilogue, const int sign,
                __global const int *restrict which, __global const int *restrict own)
{
    const int j0 = (int)get_global_id(0) * NV * VW;
    const int top = (int)get_global_id(1) * PAIRS * RT;
    const int b = (int)get_global_id(2);
    int column[NV];
    TAKE_OWN
    const int n_pairs = k / 2;
    const int m_sums = SIDE == 0 ? (m + 1) / 2 : m;      /* rows and columns that are summed */
    const int n_sums = SIDE == 0 ? n : (n + 1) / 2;
    const int width = (n_sums + 15) / 16 * 16;
    const int bottom = m_sums - top < PAIRS * RT ? m_sums : top + PAIRS * RT;
    if (j0 >= width || top >= m_sums) return;
    A += offset_a + TABLE(div_a) * stride_a;
    B += TABLE(div_b) * stride_b;
    C += offset_c + (size_t)b * stride_c;
    TAKE_NEXT
    TAKE_COLUMNS

    for (int i0 = top; i0 < bottom; i0 += PAIRS) {
        __global const REAL *row[PAIRS];
        WIDE acc[MR][NV];                   /* E and O of each row */
        UNROLL(i, PAIRS) row[i] = A + (size_t)(i0 + i < m_sums ? i0 + i : m_sums - 1) * ld_a;
        CLEAR(acc, MR, NV)
#if READ_AHEAD && SIDE == 0
        const long skipped = (i0 - top) / PAIRS % KU * 2 * (long)n_pad;
        ROLL(i, PAIRS) TO_WRITE(C + (size_t)(i0 + i) * ld_c + j0)
        ROLL(i, PAIRS) TO_WRITE(C + (size_t)(m - 1 - i0 - i) * ld_c + j0)
#elif READ_AHEAD
        if (step_c == 1) {
            ROLL(i, PAIRS) TO_WRITE(C + (size_t)(i0 + i) * ld_c + j0)
            ROLL(i, PAIRS) TO_WRITE(C + (size_t)(i0 + i) * ld_c + n - j0 - NV * VW)
        }
        if (j0 == 0)
            for (int q = 0; q < PAIRS * ld_a; q += LINE)
                PREFETCH(row[0] + PAIRS * (long)ld_a + q, 0, 3)
#endif
        for (int last = n_pairs - 1; last >= 0; last -= FOLDED) {
            const int first = last < FOLDED ? 0 : last + 1 - FOLDED;
            INSIDE(2 * (m_sums - i0), ADD_PAIRS)
        }
        HOLD_SUMS
        ROLL(i, PAIRS) ROLL(v, NV) {
            if (i0 + i >= m_sums || j0 + v * VW >= width) continue;
            const WIDE here = held[2 * i][v] + held[2 * i + 1][v];
            const WIDE there = held[2 * i][v] - held[2 * i + 1][v];
#if SIDE == 0
            AT(WIDE, C + (size_t)(i0 + i) * ld_c + column[v]) = here;
            AT(WIDE, C + (size_t)(m - 1 - i0 - i) * ld_c + column[v]) = there;
#else
            /* by addresses of lanes, as in contract.cl */
            __global REAL *c = C + (size_t)(i0 + i) * ld_c;
            const WIDE reversed = REVERSED(there);
            const REAL *lane = (const REAL *)&here, *lane_there = (const REAL *)&reversed;
            const int n_left = n_sums - column[v], first_there = n - column[v] - VW;
            if (step_c == 1 && n_left >= VW) {
                UNROLL(j, VW) c[column[v] + j] = lane[j];
                UNROLL(j, VW) c[first_there + j] = lane_there[j];
            } else {
                for (int j = 0; j < VW; ++j) {
                    if (j < n_left) c[(size_t)(column[v] + j) * step_c] = lane[j];
                    if (VW - 1 - j < n_left)
                        c[(size_t)(first_there + j) * step_c] = lane_there[j];
                }
            }
#endif
        }
    }
}
