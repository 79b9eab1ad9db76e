/* Products with a table of waves, in half the operations of contract.cl: common parts of
 * mirror_to_waves.cl (to waves) and mirror_to_pixels.cl (to pixels).
 *
 *   C[b] = A[b] . B[b], as there, where one factor is a table W (k, n) of waves at n pixels, or its
 *   transpose, whose halves mirror each other: of rows 2i, cosines, the pixels p and n - 1 - p have
 *   the same values, of rows 2i + 1, sines, opposite ones.
 *
 *                  SIDE 0, the table is A             SIDE 1, it is B
 *   mirror_to_waves.cl       C = W X:    cos (X[p] + X[-1-p])   C = X W^T, the same of the columns
 *                              of X sin (X[p] - X[-1-p])
 *   mirror_to_pixels.cl  C = W^T Z:  C[p], C[-1-p] = E +- O C = Z W, the same of the columns of C
 *
 * To waves, the sums and differences of X's halves are computed first and multiplied by half of the
 * table. Back, E is the sum over cosines and O that over sines, for half of the pixels. The middle
 * pixel of an odd number has no partner: to waves it is added last; back its C is E + O.
 *
 * Tiles, layout, batches, epilogues, OWN and arguments are those of contract.cl, but for this:
 *   Terms are added in partial sums of FOLDED pairs, the smallest first: from both ends of an image
 *   towards its middle, and from the highest frequency down. There is no `block` or `inward`.
 *   Only W X has epilogues; Z W alone is RAGGED, and always; X W^T alone may be STRIDED.
 *
 * Launch: (columns, rows, batch) as there, of W^T Z for the first half of its rows, of Z W for the
 * first half of its columns, of X W^T with one work-item for all columns. A work-item takes RT
 * tiles of MR rows, of MR / 2 on the way back.
 */
#define ON_CPU 1
#include "prefetch.h"
#include "contract.h"

#ifndef SIDE        /* factor that is the table: 0 left, 1 right */
#define SIDE 0
#endif
#ifndef RT          /* tiles that a work-item owns, one below the other; even for W X */
#define RT 2
#endif
#ifndef FOLDED      /* pairs of a partial sum: with 128, sums of 400 pixels are rounded more */
#define FOLDED 64
#endif

#if READ_AHEAD
#define NEXT_COLUMNS(from) PREFETCH((from) + next, 0, 2)
#define TO_WRITE(c) for (int j = 0; j < NV * VW; j += LINE) PREFETCH((c) + j, 1, 3)
#define TAKE_NEXT const long next = j0 + NV * VW < width ? j0 + NV * VW : stride_b;
#else
#define NEXT_COLUMNS(from)
#define TO_WRITE(c) {}
#define TAKE_NEXT
#endif

#define CLEAR(sums, mr, nv) UNROLL(i, mr) UNROLL(v, nv) sums[i][v] = (WIDE)(0);
#define TAKE_COLUMNS UNROLL(v, NV) column[v] = j0 + v * VW < width ? j0 + v * VW : j0;
/* add(rows, vectors, terms a turn) of a tile, or of what it has inside: one vector, or half of its
 * rows, two terms a turn, as in contract.h. */
#define INSIDE(n_rows, add) { \
        if (NV > 1 && n_sums - j0 <= VW) add(MR, 1, 1) \
        else if (MR > 2 && (n_rows) <= MR / 2) add(MR / 2, NV, 1) \
        else add(MR, NV, KU) \
    }
