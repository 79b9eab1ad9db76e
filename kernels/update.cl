/* One step of proximal AMSGrad (Melchior et al. 2019) on morphologies, spectra and sky levels.
 *
 *   m <- B1 m + (1 - B1) g,  v <- B2 v + (1 - B2) g^2,  h <- max(h, v)
 *   x <- x - rate (m / (1 - B1^t)) / (sqrt(h / (1 - B2^t)) + e)
 *
 * A morphology with a prior is S = P + W o (K z): P is the expected `profile`, W the `amplitude` of
 * its structure, K the correlation kernel (separable taps (2 RADIUS + 1), symmetric), z the
 * unit-normal `latent` image.  The variable is z, its gradient K (W o dS) + z; constraints act on
 * S.  Without a prior the variable is S itself.
 *
 * blur_latent         scratch = K_x v,  v = W o dS where S > 0 (weigh: the gradient), or z
 * step_latent  z <- AMSGrad with g = K_y scratch + z
 * form_latent_morphology         S = P + W o K_y scratch
 * step_morph   S <- AMSGrad with g = dS
 *              launch of these: (X, tallest box, len(active)); for the sources listed in `active`
 * step_spectra A <- max(0, AMSGrad in units of `scale` with g = scale o dA); for n = S C of them
 * step_sky     sky <- sky - SKY_RATE sum(w r) / sum(w); for n = B C levels
 *              pull (B, n_rows): sum of w r of each observed row; channel c has rows
 *              row0[c] .. row0[c + 1] - 1;  inverse (B, C): 1 / sum(w)
 * rescale_spectra  A[s, c] *= factor[s], the divisor of a morphology's normalisation; for n = S C
 *              launch of these three: any (see FOR_I of work_group.h)
 *
 * e = EPSILON + rate damping[s] for morphologies: no step is longer than gradient / damping, where
 * damping is a bound on the curvature; EPSILON for spectra, whose units are those of their errors.
 * t1 = 1 / (1 - B1^t), t2 = 1 / (1 - B2^t) come from the host.
 * table, morph, first: as in scene.cl; all flat buffers share the layout of boxes.h.
 */
#include "common.h"
#include "boxes.h"
#include "work_group.h"

#ifndef B1           /* decay of the first moment in an iteration */
#define B1 0.9
#endif
#ifndef B2           /* decay of the second moment in an iteration */
#define B2 0.999
#endif
#ifndef EPSILON      /* far below a unit-normal variable's gradient, above float32's underflow */
#define EPSILON 1e-8
#endif
#ifndef SKY_RATE     /* of a Newton step: sources and sky are coupled, so a full step overshoots */
#define SKY_RATE 0.5
#endif
#ifndef RADIUS       /* taps of K on either side of its middle one */
#define RADIUS 6
#endif

#define ROW \
    const int s = active[get_global_id(2)], y = (int)get_global_id(1); \
    __global const int *box = BOX(s); \
    const int ny = box[NY], nx = box[NX]; \
    if (y >= ny) return; \
    const size_t begin = BEGIN(box), row = begin + (size_t)y * nx;
#define LANES 16     /* parallel sums if a work-item has a whole row */

/* sqrt(x), x >= 0, from plain arithmetic so that loops vectorise everywhere: a first guess of
 * 1 / sqrt from the exponent, then Newton's steps, each of which doubles the digits from 5 bits. */
static REAL root(const REAL x)
{
#ifdef USE_DOUBLE
    REAL y = as_double(0x5fe6eb50c7b537a9L - (as_long(x) >> 1));
    y = y * (1.5 - 0.5 * x * y * y);
#else
    REAL y = as_float(0x5f3759df - (as_int(x) >> 1));
#endif
    y = y * ((REAL)1.5 - (REAL)0.5 * x * y * y);
    y = y * ((REAL)1.5 - (REAL)0.5 * x * y * y);
    y = y * ((REAL)1.5 - (REAL)0.5 * x * y * y);
    return x * y;
}

static REAL amsgrad(const REAL g, __global REAL *m, __global REAL *v, __global REAL *h,
                    const size_t i, const REAL e, const REAL t1, const REAL t2)
{
    const REAL mi = (REAL)B1 * m[i] + (REAL)(1 - B1) * g;
    const REAL vi = (REAL)B2 * v[i] + (REAL)(1 - B2) * g * g;
    const REAL hi = h[i] > vi ? h[i] : vi;
    m[i] = mi;
    v[i] = vi;
    h[i] = hi;
    return mi * t1 / (root(hi * t2) + e);
}

__kernel void blur_latent(__global const int *restrict active, __global const int *restrict table,
                   __global const REAL *restrict taps, const int weigh,
                   __global const REAL *restrict v, __global const REAL *restrict amplitude,
                   __global const REAL *restrict morph, __global REAL *restrict weighed,
                   __global REAL *restrict scratch)
{
    ROW
    __global const REAL *source = v + row;
#if ROWS
    if (weigh) {                       /* once a pixel rather than once a tap */
        for (int x = 0; x < nx; ++x)
            weighed[row + x] = morph[row + x] > 0 ? amplitude[row + x] * v[row + x] : (REAL)0;
        source = weighed + row;
    }
    for (int x = 0; x < nx; ++x) scratch[row + x] = 0;
    for (int t = -RADIUS; t <= RADIUS; ++t) {
        const int low = t < 0 ? -t : 0, high = t > 0 ? nx - t : nx;
        const REAL k = taps[t + RADIUS];
        for (int x = low; x < high; ++x) scratch[row + x] += k * source[x + t];
    }
#else
    FOR_X(x, nx) {
        REAL sum = 0;
        for (int t = -RADIUS; t <= RADIUS; ++t) {
            const int i = x + t;
            if (i < 0 || i >= nx) continue;
            const REAL u = weigh ? (morph[row + i] > 0 ? amplitude[row + i] * source[i] : (REAL)0)
                                 : source[i];
            sum += taps[t + RADIUS] * u;
        }
        scratch[row + x] = sum;
    }
#endif
}

/* K_y scratch of one row into `out`. */
static void blur_y(__global const REAL *taps, __global const REAL *scratch, const size_t begin,
                   const int y, const int ny, const int nx, __global REAL *out)
{
    const size_t row = begin + (size_t)y * nx;
    const int low = y > RADIUS ? -RADIUS : -y, high = ny - 1 - y < RADIUS ? ny - 1 - y : RADIUS;
    __global const REAL *k = taps + RADIUS;
#if ROWS
    int x = 0;
    for (; x + LANES <= nx; x += LANES) {
        REAL sum[LANES];
        for (int l = 0; l < LANES; ++l) sum[l] = 0;
        for (int t = low; t <= high; ++t)
            for (int l = 0; l < LANES; ++l) sum[l] += k[t] * scratch[row + t * nx + x + l];
        for (int l = 0; l < LANES; ++l) out[row + x + l] = sum[l];
    }
    for (; x < nx; ++x) {
#else
    FOR_X(x, nx) {
#endif
        REAL sum = 0;
        for (int t = low; t <= high; ++t) sum += k[t] * scratch[row + t * nx + x];
        out[row + x] = sum;
    }
}

__kernel void step_latent(__global const int *restrict active, __global const int *restrict table,
                          __global const REAL *restrict damping,
                          __global const REAL *restrict taps,
                          __global const REAL *restrict scratch, __global REAL *restrict latent,
                          __global REAL *restrict m, __global REAL *restrict v,
                          __global REAL *restrict h, __global REAL *restrict gradient,
                          const REAL rate, const REAL t1, const REAL t2)
{
    ROW
    const REAL e = (REAL)EPSILON + rate * damping[s];
    blur_y(taps, scratch, begin, y, ny, nx, gradient);
    FOR_X(x, nx) {
        const size_t i = row + x;
        latent[i] -= rate * amsgrad(gradient[i] + latent[i], m, v, h, i, e, t1, t2);
    }
}

__kernel void form_latent_morphology(__global const int *restrict active,
        __global const int *restrict table,
                   __global const REAL *restrict taps, __global const REAL *restrict scratch,
                   __global const REAL *restrict profile, __global const REAL *restrict amplitude,
                   __global REAL *restrict morph)
{
    ROW
    blur_y(taps, scratch, begin, y, ny, nx, morph);
    FOR_X(x, nx) morph[row + x] = profile[row + x] + amplitude[row + x] * morph[row + x];
}

__kernel void step_morph(__global const int *restrict active, __global const int *restrict table,
                         __global const REAL *restrict damping,
                         __global const REAL *restrict gradient, __global REAL *restrict morph,
                         __global REAL *restrict m, __global REAL *restrict v,
                         __global REAL *restrict h, const REAL rate, const REAL t1, const REAL t2)
{
    ROW
    const REAL e = (REAL)EPSILON + rate * damping[s];
    FOR_X(x, nx) {
        const size_t i = row + x;
        morph[i] -= rate * amsgrad(gradient[i], m, v, h, i, e, t1, t2);
    }
}

__kernel void step_spectra(__global const REAL *restrict gradient,
                           __global const REAL *restrict scale, __global REAL *restrict spectra,
                           __global REAL *restrict m, __global REAL *restrict v,
                           __global REAL *restrict h, const REAL rate, const REAL t1, const REAL t2,
                           const int n)
{
    FOR_I(i, n) {
        const REAL a = spectra[i]
                     - rate * scale[i] * amsgrad(scale[i] * gradient[i], m, v, h, i,
                                                   (REAL)EPSILON, t1, t2);
        spectra[i] = a < 0 ? (REAL)0 : a;
    }
}

__kernel void step_sky(const int n_channels, const int n_rows, __global const int *restrict row0,
                       __global const REAL *restrict pull, __global const REAL *restrict inverse,
                       __global REAL *restrict sky, const int n)
{
    FOR_I(i, n) {
        const int b = i / n_channels, c = i % n_channels;
        REAL sum = 0;
        for (int r = row0[c]; r < row0[c + 1]; ++r) sum += pull[(size_t)b * n_rows + r];
        sky[i] -= (REAL)SKY_RATE * sum * inverse[i];
    }
}

__kernel void rescale_spectra(__global const REAL *restrict factor, const int n_channels,
                      __global REAL *restrict spectra, const int n)
{
    FOR_I(i, n) spectra[i] *= factor[i / n_channels];
}
