/* Multiplication by a transfer function, for all kernels that do it.
 *
 * A quad (CC, CS, SC, SS) holds the products of cos and sin along y with cos and sin along x at one
 * frequency of each axis.  It is a pair of complex amplitudes, F(+nu_y, +nu_x) and
 * F(+nu_y, -nu_x).  D(+,+) = pr + i pi multiplies the first, D(+,-) = mr + i mi the second, and the
 * macro writes the products as a quad.  type: of each argument, a scalar or a vector.  The output
 * may be the input.
 */
#define TIMES_TRANSFER(type, pr, pi, mr, mi, cc, cs, sc, ss, to_cc, to_cs, to_sc, to_ss) { \
        const type fpr = (cc) - (ss), fpi = -((cs) + (sc));     /* F(+nu_y, +nu_x) */ \
        const type fmr = (cc) + (ss), fmi = (cs) - (sc);        /* F(+nu_y, -nu_x) */ \
        const type gpr = (pr) * fpr - (pi) * fpi, gpi = (pr) * fpi + (pi) * fpr; \
        const type gmr = (mr) * fmr - (mi) * fmi, gmi = (mr) * fmi + (mi) * fmr; \
        to_cc = gpr + gmr; \
        to_cs = gmi - gpi; \
        to_sc = -(gpi + gmi); \
        to_ss = gmr - gpr; \
    }
