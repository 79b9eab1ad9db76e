/* Bands that add up T images of the model, one through each PSF of a basis, at the frequencies.
 *
 *   z (n, 2 h_y, n_pad): of each of n images of the observation, n_bands of them for each plan
 *   terms (n, T, 2 h_y, n_pad): its parts.  Both hold quads as contract.cl has them
 *
 * add      z = sum_t terms[t]
 * spread   terms[t] = conj(D_t) o z;  D (plans, n_bands, T, h_y, 4, n_pad / 2) as MIX has it,
 *          stride_d: elements from a plan's to the next
 *
 * Launch: (X, h_y, n); X is 1 where a work-item walks a whole row (ROWS of group.h), else n_pad / 2
 */
#include "common.h"
#include "group.h"

__kernel void add(const int n_terms, const int h_y, const int n_pad,
                  __global const REAL *restrict terms, __global REAL *restrict z)
{
    const size_t image = get_global_id(2), plane = (size_t)2 * h_y * n_pad;
    FOR_Y(i, h_y) {
        const size_t row = (size_t)2 * i * n_pad;
        __global const REAL *in = terms + image * n_terms * plane + row;
        __global REAL *out = z + image * plane + row;
        FOR_X(j, n_pad / 2) for (int k = 0; k < 4; ++k) {
            const size_t at = (size_t)(k / 2) * n_pad + 2 * j + k % 2;
            REAL sum = 0;
            for (int t = 0; t < n_terms; ++t) sum += in[t * plane + at];
            out[at] = sum;
        }
    }
}

__kernel void spread(const int n_terms, const int h_y, const int n_pad, const int n_bands,
                     __global const REAL *restrict D, const int stride_d,
                     __global const REAL *restrict z, __global REAL *restrict terms)
{
    const size_t image = get_global_id(2), plane = (size_t)2 * h_y * n_pad;
    const int n_half = n_pad / 2;
    D += image / n_bands * stride_d + image % n_bands * n_terms * plane;
    FOR_Y(i, h_y) {
        const size_t row = (size_t)2 * i * n_pad;
        __global const REAL *in = z + image * plane + row;
        FOR_X(j, n_half) {
            const REAL cc = in[2 * j], cs = in[2 * j + 1];
            const REAL sc = in[n_pad + 2 * j], ss = in[n_pad + 2 * j + 1];
            const REAL fpr = cc - ss, fpi = -(cs + sc), fmr = cc + ss, fmi = cs - sc;
            for (int t = 0; t < n_terms; ++t) {
                __global const REAL *d = D + t * plane + row + j;
                __global REAL *out = terms + (image * n_terms + t) * plane + row + 2 * j;
                const REAL pr = d[0], pi = -d[n_half], mr = d[2 * n_half], mi = -d[3 * n_half];
                const REAL gpr = pr * fpr - pi * fpi, gpi = pr * fpi + pi * fpr;
                const REAL gmr = mr * fmr - mi * fmi, gmi = mr * fmi + mi * fmr;
                out[0] = gpr + gmr;
                out[1] = gmi - gpi;
                out[n_pad] = -(gpi + gmi);
                out[n_pad + 1] = gmr - gpr;
            }
        }
    }
}
