/* Tables of the normalised sinc, the 1-D factors of Whittaker-Shannon interpolation.
 *
 *   table[p, i] = sinc(x_p - (first + i)),   sinc(x) = sin(pi x) / (pi x)
 *
 *   whole (n_positions) int, part (n_positions) REAL: x_p = whole_p + part_p, |part_p| <= 1/2,
 *       split by the host in float64.  sin(pi (x_p - i)) = (-1)^(whole_p - i) sin(pi part_p)
 *       needs no further reduction of the argument, so float32 tables are accurate at any distance.
 *   table: element (p, i) at p * step_p + i * step_i: positions may run along rows or columns
 *
 * Boundary: writes these elements only; padding is the caller's.
 * Launch: (n_integers rounded up, n_positions).
 */
#include "common.h"

#define PI ((REAL)3.14159265358979323846)

/* sin(pi r) / (pi r) for t = (pi r)^2, |r| <= 1/2: the Taylor series sum (-t)^k / (2k + 1)!.
 * Remainder at r = 1/2: 4e-10 after 7 terms (float), 1e-18 after 11 (double). */
static REAL sinc_near(const REAL t)
{
#ifdef USE_DOUBLE
    REAL s = 1 - t / 420;
    s = 1 - t / 342 * s;
    s = 1 - t / 272 * s;
    s = 1 - t / 210 * s;
#else
    REAL s = 1;
#endif
    s = 1 - t / 156 * s;
    s = 1 - t / 110 * s;
    s = 1 - t / 72 * s;
    s = 1 - t / 42 * s;
    s = 1 - t / 20 * s;
    return 1 - t / 6 * s;
}

__kernel void sinc(const int n_integers, const int first, __global const int *restrict whole,
                   __global const REAL *restrict part, __global REAL *restrict table,
                   const int step_p, const int step_i)
{
    const int i = (int)get_global_id(0), p = (int)get_global_id(1);
    if (i >= n_integers) return;
    const int distance = whole[p] - first - i;
    const REAL r = part[p], near = sinc_near(PI * r * (PI * r));
    const REAL far = (distance & 1 ? -near : near) * r / (distance + r + (distance == 0));
    table[(size_t)p * step_p + (size_t)i * step_i] = distance == 0 ? near : far;
}
