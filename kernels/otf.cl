// otf.cl : exact optical transfer function of the square stop along one axis.
//
// otf_1d: cubic mask and defocus, at any frequencies.
//
//   2 H = sgn(s-) e^{i phi-} E(|s-|) - e^{i phi+} E(s+) + [s- < 0] (1 + i)/k e^{i phi_s}   docs/maths.md, eq. O4
//
//   u         (n, 2) real     normalised frequency, hi and lo; H is 0 for |u| > 2
//   gain      (n, 2) real     factors of Re H and Im H: a pixel's transfer, and 0 for the imaginary part of a
//                             Nyquist bin
//   otf       (rows, n) cplx  row `row` is written
//   n, row    >= 1, >= 0
//   alpha_*   real, turns     |alpha|/(2 pi), hi and lo
//   psi_*     real, turns     |psi|/(2 pi), hi and lo
//   shift_*   real, turns     psi^2/(3 |alpha|)/(2 pi), hi and lo; anything finite when |psi| >= 3 |alpha|
//   sign      +1 or -1        the sign of alpha
//
// One work-item per frequency; no local memory, no barriers.
// Error: below 4e-7 in float, 5e-14 in double, for |alpha| <= 1e4, |psi| <= 150 (PoCL, Intel).
//
// otf_field, otf_fft, otf_power, otf_half: any other profile, by transforms of m = 2 n points.
//
//   H(2 j/n) = 1/n sum_i P_{i+j} conj P_i                                            docs/maths.md, eq. O10
//
//   turns     (n) real   phase at the cell centres
//   field     (m) cplx   the pupil, zero-padded; x and y of otf_fft: see stockham.h
//   roots     (m/2) cplx exp(-2 pi i k/m)
//   otf       (n + 1) cplx   result at u = 0, 2/n .. 2
//   n or m, s, sign      see stockham.h
//   scale     real       1/(m n): the inverse transform's and the definition's
//
// One work-item per sample or butterfly; no local memory, no barriers.
// Error: that of the cells, 0.2 (3 alpha + 2 psi)/n^2, and of rounding: 1e-6 in float, 1e-15 in double.

#include "fresnel.h"
#include "two_term.h"
#include "stockham.h"

// 1/(4 pi): below this, b s+ < 1/2 and the whole phase stays within a radian.
#define SHORT_TURNS REAL_C(0.079577471545947667884)

// Positive half of the ten Gauss-Legendre nodes on [-1, 1], and their weights.
static __constant real2 gauss_legendre[5] = {
    (real2)(REAL_C(0.14887433898163121088), REAL_C(0.29552422471475287017)),
    (real2)(REAL_C(0.43339539412924719080), REAL_C(0.26926671930999635509)),
    (real2)(REAL_C(0.67940956829902440623), REAL_C(0.21908636251598204400)),
    (real2)(REAL_C(0.86506336668898451073), REAL_C(0.14945134915058059315)),
    (real2)(REAL_C(0.97390652851717172008), REAL_C(0.066671344308688137594))
};

// E(s) of eq. O5 for s = 2 pi turns >= 0.
static inline cplx otf_end(const real turns, const real k)
{
    const real z = 4 * turns, a = FRESNEL_SCALE * k;
    return fresnel_tail((z - a) / (z + a)) / (z + a);
}

static inline cplx otf_value(const two_term w, const two_term alpha, const two_term psi, const two_term shift)
{
    const two_term b = two_term_add((two_term)(1, 0), two_term_scale(w, -REAL_C(0.5)));
    if (b.x <= 0) return (cplx)(0);

    // Everything in turns; c = 6 pi aw, q = 2 pi pw.
    const two_term aw = two_term_mul(alpha, w);
    const two_term pw = two_term_mul(psi, w);
    const two_term cb = two_term_mul(two_term_add(two_term_scale(aw, 2), aw), b);
    const two_term high = two_term_add(pw, cb);
    const two_term low = two_term_add(pw, -cb);
    const real phase_w = two_term_fraction(two_term_scale(two_term_mul(aw, two_term_mul(w, w)), REAL_C(0.25)));
    const two_term even = two_term_mul(cb, b);
    const two_term odd = two_term_scale(two_term_mul(pw, b), 2);

    if (b.x * high.x < SHORT_TURNS) {
        cplx sum = (cplx)(0);
        for (int i = 0; i < 5; ++i) {
            const real t = gauss_legendre[i].x;
            sum += gauss_legendre[i].y * cospi(2 * odd.x * t) * turns_cis(even.x * t * t);
        }
        return b.x * cplx_mul(sum, turns_cis(phase_w));
    }

    const real k = sqrt(12 * aw.x);
    const real middle = phase_w + two_term_fraction(even);
    const real half_run = two_term_fraction(odd);
    const cplx far = cplx_mul(turns_cis(middle + half_run), otf_end(high.x, k));
    const cplx near = cplx_mul(turns_cis(middle - half_run), otf_end(fabs(low.x), k));
    if (low.x >= 0) return REAL_C(0.5) * (near - far);
    const cplx stationary = cplx_mul((cplx)(1, 1), turns_cis(phase_w - two_term_fraction(two_term_mul(shift, w))));
    return REAL_C(0.5) * (stationary / k - near - far);
}

__kernel void otf_1d(
    __global const real2 *u,
    __global const real2 *gain,
    __global cplx        *otf,
    const int n, const int row,
    const real alpha_hi, const real alpha_lo,
    const real psi_hi, const real psi_lo,
    const real shift_hi, const real shift_lo,
    const real sign)
{
    const int i = get_global_id(0);
    if (i >= n) return;

    const two_term v = u[i];
    const real side = v.x < 0 ? -1 : 1;
    cplx h = otf_value(side * v, (two_term)(alpha_hi, alpha_lo), (two_term)(psi_hi, psi_lo),
                       (two_term)(shift_hi, shift_lo));
    if (v.x * sign < 0) h = cplx_conj(h);
    otf[row * n + i] = h * gain[i];
}

__kernel void otf_field(__global const real *turns, __global cplx *field, const int n)
{
    const int i = get_global_id(0);
    if (i >= 2 * n) return;
    cplx value = (cplx)(0);
    if (i < n) value = turns_cis(turns[i]);
    field[i] = value;
}

__kernel void otf_fft(
    __global const cplx *x,
    __global const cplx *roots,
    __global cplx       *y,
    const int m, const int s, const int sign)
{
    const int j = get_global_id(0);
    if (j >= m / 2) return;
    stockham_pass(x, y, roots, 0, 1, m, s, j, sign);
}

__kernel void otf_power(__global cplx *field, const int m, const real scale)
{
    const int i = get_global_id(0);
    if (i >= m) return;
    const cplx f = field[i];
    field[i] = scale * cplx_mul(f, cplx_conj(f));   // the imaginary parts cancel to the last bit
}

__kernel void otf_half(__global const cplx *field, __global cplx *otf, const int n)
{
    const int j = get_global_id(0);
    if (j > n) return;
    otf[j] = j < n ? field[j] : (cplx)(0);   // at j = n, u = 2, nothing overlaps
}
