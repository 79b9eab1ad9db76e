/* Copies into and out of the vectors of lbfgs.cl, the variables of all scenes of a batch.
 *
 * unpack_spectra  spectra and sky levels out of x, n of them in all;  launch: any, see FOR_I of
 *     work_group.h
 * pack_gradients  their gradients into g_new: pull[b, row] summed over rows row0[c] .. row0[c + 1]
 *           - 1;  launch: as for unpack_spectra
 * copy_chunks  values[row, first + i] = values_from[row, source + i] of each chunk, the source of
 *           each given; launch: (WG, n chunks, rows)
 */
#include "common.h"
#include "work_group.h"

__kernel void unpack_spectra(const int n_latents, const int n_spectra, const int n,
                   __global const REAL *restrict x, __global REAL *restrict spectra,
                   __global REAL *restrict sky)
{
    FOR_I(i, n) {
        const REAL value = x[(size_t)n_latents + i];
        if (i < n_spectra) spectra[i] = value;
        else sky[i - n_spectra] = value;
    }
}

__kernel void pack_gradients(const int n_latents, const int n_spectra, const int n,
        const int n_channels,
                   const int n_rows, __global const int *restrict row0,
                   __global const REAL *restrict pull, __global const REAL *restrict d_spectra,
                   __global REAL *restrict g_new)
{
    FOR_I(i, n) {
        const int k = i - n_spectra;
        REAL sum = 0;
        if (i < n_spectra) sum = d_spectra[i];
        else {
            __global const REAL *rows = pull + (size_t)(k / n_channels) * n_rows;
            for (int r = row0[k % n_channels]; r < row0[k % n_channels + 1]; ++r) sum += rows[r];
        }
        g_new[(size_t)n_latents + i] = sum;
    }
}

__kernel __attribute__((reqd_work_group_size(WG, 1, 1)))
void copy_chunks(__global const int *restrict chunks, __global const int *restrict source,
          const ulong size, const ulong size_from, __global const REAL *restrict values_from,
          __global REAL *restrict values)
{
    const int lid = (int)get_local_id(0), chunk = (int)get_global_id(1);
    const size_t row = get_global_id(2), n = chunks[4 * chunk + 2];
    __global REAL *to = values + row * size + chunks[4 * chunk + 1];
    __global const REAL *from = values_from + row * size_from + source[chunk];
    for (size_t i = lid; i < n; i += WG) to[i] = from[i];
}
