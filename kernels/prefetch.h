/* Prefetching, for kernels whose work-items read memory sequentially, as on CPUs. */
#ifndef READ_AHEAD  /* 1: prefetch by a builtin of clang and GCC */
#define READ_AHEAD 0
#endif
#if READ_AHEAD
#define PREFETCH(from, writes, cache) \
    __builtin_prefetch((const void *)(size_t)(from), writes, cache);
#define LINE (64 / (int)sizeof(REAL))       /* elements of a cache line */
#endif
