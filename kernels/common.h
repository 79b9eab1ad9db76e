/* The one floating type of a build.
 *
 * The host prepends "#define REAL float", or "#define REAL double" with "#define USE_DOUBLE",
 * before each file. A file begins with #include "common.h", which the host replaces by this text,
 * because some drivers' build caches do not detect changes of includes.
 *
 * VEC(n) is the vector type of n REALs: VEC(4) is float4 or double4.
 * AT(type, p) is the value of that type at address p: AT(const VEC(4), p) reads p[0] .. p[3].
 * SUM8(p) adds p[0] .. p[7] in pairs: eight running sums vectorise, and round less than one.
 * UNROLL(i, n) is an unrolled loop over i < n, a constant: otherwise arrays indexed by i would be
 * in memory instead of registers.
 * ROLL(i, n) is such a loop without unrolling, for code that runs once a tile on values in memory:
 * it compiles in a tenth of the time.
 * INLINE begins a function with vector arguments. If such a function is not inlined, PoCL splits
 * the widest vectors in two.
 */
#ifndef REAL         /* float or double */
#define REAL float
#endif
#ifdef USE_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif
#define VEC_PASTE(type, n) type##n
#define VEC_EXPAND(type, n) VEC_PASTE(type, n)
#define VEC(n) VEC_EXPAND(REAL, n)
#define AT(type, p) (*(__global type *)(p))
#define SUM8(p) \
    ((((p)[0] + (p)[1]) + ((p)[2] + (p)[3])) + (((p)[4] + (p)[5]) + ((p)[6] + (p)[7])))
#define UNROLL(i, n) _Pragma("unroll") for (int i = 0; i < (n); ++i)
#define ROLL(i, n) _Pragma("nounroll") for (int i = 0; i < (n); ++i)
#define INLINE static inline __attribute__((always_inline))
#define SQRT_HALF ((REAL)0.70710678118654752440)
