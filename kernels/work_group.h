/* Work-items that share one box, and loops over the pixels of a row.
 *
 * A group has WG work-items and one source, whose pixels they share; SYNC() is a barrier. With WG 1
 * there is no barrier, as is best for CPUs; GPUs use 64, or 256 for long vectors.
 * FOR_X runs over a row of n pixels: all of them in one work-item (ROWS), or those of this one.
 * FOR_Y runs over this work-item's share of n rows, by the second axis of the launch; FOR_I over
 * its share of n items, by the first axis.  A launch of any size covers all of them and no more, so
 * that it may be rounded up to whole groups.
 */
#ifndef WG          /* work-items of a group */
#define WG 1
#endif
#ifndef ROWS        /* 1: a work-item walks whole rows, which compilers for CPUs vectorise */
#define ROWS 0
#endif

#if WG > 1
#define SYNC() barrier(CLK_GLOBAL_MEM_FENCE | CLK_LOCAL_MEM_FENCE)
#else
#define SYNC()
#endif

#if ROWS
#define FOR_X(x, n) for (int x = 0; x < (n); ++x)
#else
#define FOR_X(x, n) for (int x = (int)get_global_id(0); x < (n); x += (int)get_global_size(0))
#endif

#define FOR_Y(y, n) for (int y = (int)get_global_id(1); y < (n); y += (int)get_global_size(1))
#define FOR_I(i, n) for (int i = (int)get_global_id(0); i < (n); i += (int)get_global_size(0))

/* The sum of a group's values, in the order of its work-items and the same for each of them.
 * share: WG elements; all work-items must come here, with their lid = get_local_id(0). */
static REAL group_sum(const REAL value, const int lid, __local REAL *share)
{
    REAL total = value;
#if WG > 1
    SYNC();                                  /* the values of an earlier sum have been read */
    share[lid] = value;
    SYNC();
    total = share[0];
    for (int k = 1; k < WG; ++k) total += share[k];
#endif
    return total;
}

/* The sums of each of N values by halves, likewise, for groups of many; WG is a power of 2.
 * share: N * WG elements. Not for loops that end by their values: PoCL crashes there. */
#if WG > 1
#define GROUP_SUMS(values, N, lid, share) \
    SYNC(); \
    for (int q = 0; q < (N); ++q) share[q * WG + lid] = values[q]; \
    for (int apart = WG / 2; apart > 0; apart /= 2) { \
        SYNC(); \
        if (lid < apart) \
            for (int q = 0; q < (N); ++q) share[q * WG + lid] += share[q * WG + lid + apart]; \
    } \
    SYNC(); \
    for (int q = 0; q < (N); ++q) values[q] = share[q * WG];
#else
#define GROUP_SUMS(values, N, lid, share)
#endif

/* The largest of a group's values, likewise. */
static REAL group_max(const REAL value, const int lid, __local REAL *share)
{
    REAL most = value;
#if WG > 1
    SYNC();
    share[lid] = value;
    SYNC();
    most = share[0];
    for (int k = 1; k < WG; ++k) most = share[k] > most ? share[k] : most;
#endif
    return most;
}
