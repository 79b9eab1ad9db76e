/* Reading ahead, for kernels whose work-items walk through memory alone, as on CPUs. */
#ifndef READ_AHEAD  /* 1: fetch what is soon needed, by a builtin of clang and GCC */
#define READ_AHEAD 0
#endif
#if READ_AHEAD
#define PREFETCH(from, writes, cache) \
    __builtin_prefetch((const void *)(size_t)(from), writes, cache);
#define LINE (64 / (int)sizeof(REAL))       /* elements that come at once */
#endif
