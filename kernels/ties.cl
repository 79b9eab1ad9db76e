/* Gradients by the spectra of channels that are exposures of one band.
 *
 * tie       d_spectra[s, c] = mean of d_spectra[s, c'] over the channels c' of c's band
 *           first[c]: the first channel of the band of c, count[c]: how many it has
 *           layout: d_spectra (n_sources, n_channels);
 *           launch: n_sources items, see FOR_I of work_group.h
 */
#include "common.h"
#include "work_group.h"

__kernel void tie(const int n_sources, const int n_channels, __global const int *restrict first,
                  __global const int *restrict count, __global REAL *restrict d_spectra)
{
    FOR_I(s, n_sources) {
        __global REAL *row = d_spectra + (size_t)s * n_channels;
        for (int b = 0; b < n_channels; ++b) {
            if (first[b] != b || count[b] == 1) continue;
            REAL sum = 0;
            for (int c = b; c < n_channels; ++c) sum += first[c] == b ? row[c] : (REAL)0;
            for (int c = b; c < n_channels; ++c) if (first[c] == b) row[c] = sum / (REAL)count[b];
        }
    }
}
