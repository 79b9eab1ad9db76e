/* The one floating type of a build.
 *
 * The host prepends "#define REAL float", or "#define REAL double" with "#define USE_DOUBLE",
 * before each file. A file opens with #include "common.h"; the host pastes this text there, since
 * some drivers' build caches do not notice a changed include.
 *
 * VEC(n) is the vector type of n REALs: VEC(4) is float4 or double4.
 */
#ifndef REAL
#define REAL float
#endif
#ifdef USE_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif
#define VEC_PASTE(type, n) type##n
#define VEC_EXPAND(type, n) VEC_PASTE(type, n)
#define VEC(n) VEC_EXPAND(REAL, n)
