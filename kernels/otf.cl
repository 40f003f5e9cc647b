// otf.cl : exact optical transfer function of the square stop along one axis.
//
// otf_1d: cubic mask and defocus, for many pairs of both, at any frequencies of any number of axes, in one launch.
//
//   2 H = sgn(s-) e^{i phi-} E(|s-|) - e^{i phi+} E(s+) + [s- < 0] (1 + i)/k e^{i phi_s}   docs/maths.md, eq. O4
//
//   terms     (blocks, TERMS, LANES) real; of one lane (TERMS, blocks)   what depends on |u| alone, see the list below
//   places    (blocks) int4   of a block of frequencies: where its first goes in a row; where the mirror image of
//                             that goes, -1 for none: conj H, at descending places; how many it holds; 0
//   least     (blocks, 2) real   smallest RUN and SLOPE x REMAINS of a block, to find blocks with short phases
//   otf       (rows, n) cplx  rows `first_row` onwards are written, at the places named
//   n, blocks, each, first_row   each: blocks of a work-item
//   pairs     by value, for each row: alpha and psi over 2 pi, hi and lo
//
// A work-item takes `each` blocks of a row, LANES frequencies at a time; one on devices without lanes. No local memory,
// no barriers.
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

#include "two_term.h"
#include "stockham.h"

// two_term.h forbids to fuse products and sums. From here on nothing depends on that, and fused they cost half.
#pragma OPENCL FP_CONTRACT ON

#include "fresnel.h"
#include "turns.h"

#ifndef OTF_PAIRS
#define OTF_PAIRS 1   // pairs that one launch can take
#endif

typedef struct { two_term alpha, psi; } otf_pair;
typedef struct { otf_pair row[OTF_PAIRS]; } otf_pairs;

// For w = |u| up to 2 and b = 1 - w/2. NAME and NAME_FINE: the leading half of a number's bits, and the rest.
enum {
    END, END_FINE,       // 1 - (1 - w)^3: phi+ and phi- over alpha
    RUN, RUN_FINE,       // 1 - (1 - w)^2 = 2 w b: phi+ over psi
    CUBE, CUBE_FINE,     // w^3/4
    W, W_FINE,           // w
    TWICE, SLOPE,        // 2 w and 6 w b: 2 q over psi, 2 c b over alpha
    REMAINS,             // b
    ROOT, OVER_ROOT,     // sqrt w, and its inverse; 0 for w < 1e-9
    GAIN_RE, GAIN_IM,    // factors of H, 0 beyond the cut-off; the sign of u stands on the second
    TERMS
};

#if LANES == 1
#define TERM(NAME) terms[(NAME) * blocks + block]
#else
#define TERM(NAME) terms[block * TERMS + (NAME)]
#endif

// 1/(2 pi): while 2 b s+, in turns, is below, the whole phase stays within a radian.
#define SHORT REAL_C(0.15915494309189533577)

// Positive half of the Gauss-Legendre nodes on [-1, 1], six (float) or ten (double), and their weights.
#if REAL_IS_DOUBLE
#define NODES 5
static __constant real2 gauss_legendre[NODES] = {
    (real2)(REAL_C(0.14887433898163121088), REAL_C(0.29552422471475287017)),
    (real2)(REAL_C(0.43339539412924719080), REAL_C(0.26926671930999635509)),
    (real2)(REAL_C(0.67940956829902440623), REAL_C(0.21908636251598204400)),
    (real2)(REAL_C(0.86506336668898451073), REAL_C(0.14945134915058059315)),
    (real2)(REAL_C(0.97390652851717172008), REAL_C(0.066671344308688137594))
};
#else
#define NODES 3
static __constant real2 gauss_legendre[NODES] = {
    (real2)(REAL_C(0.23861918608319690863), REAL_C(0.46791393457269104739)),
    (real2)(REAL_C(0.66120938646626451366), REAL_C(0.36076157304813860757)),
    (real2)(REAL_C(0.93246951420315202781), REAL_C(0.17132449237917034504))
};
#endif

// H by quadrature of eq. O1, for phases (even x^2 + odd x + cube) in turns, x from -1 to 1, that stay within a radian.
ALWAYS_INLINE void otf_short(const vec even, const vec odd, const vec cube, const vec remains, cvec *h)
{
    h->re = 0;
    h->im = 0;
    for (int i = 0; i < NODES; ++i) {
        const real t = gauss_legendre[i].x;
        cvec along, across;
        turns_wave(odd * t, &along);
        turns_wave(even * (t * t), &across);
        const vec weight = gauss_legendre[i].y * remains * along.re;
        h->re += weight * across.re;
        h->im += weight * across.im;
    }
    turns_rotate(h, cube);
}

#if LANES > 1
#if LANES == 2
#define REVERSED(V) (V).s10
#elif LANES == 4
#define REVERSED(V) (V).s3210
#elif LANES == 8
#define REVERSED(V) (V).s76543210
#else
#define REVERSED(V) (V).sfedcba9876543210
#endif

// Rows begin anywhere: this promises no more than its element's alignment.
typedef vec loose_vec __attribute__((aligned(sizeof(real))));

ALWAYS_INLINE void otf_store(__global cplx *to, const vec re, const vec im)
{
    __global loose_vec *const out = (__global loose_vec *)to;
    vec lower, upper;
    lower.even = re.lo;
    lower.odd = im.lo;
    upper.even = re.hi;
    upper.odd = im.hi;
    out[0] = lower;
    out[1] = upper;
}
#endif

// The mirror image first: the Nyquist bin is its own, and keeps its sign.
ALWAYS_INLINE void otf_place(__global cplx *row, const int4 place, const vec re, const vec im)
{
#if LANES == 1
    if (place.y >= 0) row[place.y] = (cplx)(re, -im);
    row[place.x] = (cplx)(re, im);
#else
    if (place.z == LANES) {
        if (place.y >= 0) otf_store(row + place.y - (LANES - 1), REVERSED(re), REVERSED(-im));
        otf_store(row + place.x, re, im);
        return;
    }
    union { vec all; real of[LANES]; } x, y;
    x.all = re;
    y.all = im;
    for (int i = 0; i < place.z; ++i) {
        if (place.y >= 0) row[place.y - i] = (cplx)(x.of[i], -y.of[i]);
        row[place.x + i] = (cplx)(x.of[i], y.of[i]);
    }
#endif
}

__kernel WIDE void otf_1d(
    __global const vec   *terms,
    __global const int4  *places,
    __global const real2 *least,
    __global cplx        *otf,
    const int n, const int blocks, const int each, const int first_row,
    const otf_pairs pairs)
{
    const int first = get_global_id(0) * each, last = min(first + each, blocks);
    const int index = get_global_id(1);
    __global cplx *const row = otf + (first_row + index) * n;

    const real side = pairs.row[index].alpha.x < 0 ? -1 : 1;
    const two_term a = two_term_scale(pairs.row[index].alpha, side);
    const two_term p = two_term_scale(pairs.row[index].psi, pairs.row[index].psi.x < 0 ? -1 : 1);
    // psi^2/(3 alpha): of use only while the stationary point lies within the stop
    const two_term edge = two_term_add(two_term_scale(a, 2), a);
    const two_term s = p.x < edge.x ? two_term_div(two_term_mul(p, p), edge) : (two_term)(0);
    turns_factor alpha, psi, shift;
    turns_split(a, &alpha);
    turns_split(p, &psi);
    turns_split(s, &shift);
    const real k_root = sqrt(12 * alpha.all);                                           // k = k_root sqrt w
    const real over_k_root = alpha.all > 0 ? REAL_C(0.70710678118654752440) / k_root : 0;   // sqrt 2/(2 k_root)
    const real scaled_root = REAL_C(0.5) * FRESNEL_SCALE * k_root;

    for (int block = first; block < last; ++block) {
        // In half turns: q, c b, s+ and s-.
        const vec twice_q = psi.all * TERM(TWICE), twice_cb = alpha.all * TERM(SLOPE);
        const vec high = twice_q + twice_cb, low = twice_q - twice_cb;
        const vec k = scaled_root * TERM(ROOT);   // a k/2
        const ivec passed = low < 0;   // the stationary point lies within the overlap
        const vec k_low = passed ? -k : k;
        const vec over_high = 1 / (high + k), over_low = 1 / (low + k_low);   // the second with the sign of s-

        const vec end = turns_product(alpha, TERM(END), TERM(END_FINE));
        const vec run = turns_product(psi, TERM(RUN), TERM(RUN_FINE));
        const vec cube = turns_product(alpha, TERM(CUBE), TERM(CUBE_FINE));
        // 1 + i is sqrt 2 and an eighth of a turn.
        const vec point = (cube - turns_product(shift, TERM(W), TERM(W_FINE))) + REAL_C(0.125);

        cvec far, near, ridge, h;
        fresnel_tails(2 * k * over_high - 1, over_high, &far, 2 * k_low * over_low - 1, over_low, &near);
        turns_rotate(&far, end + run);
        turns_rotate(&near, end - run);
        turns_wave(point, &ridge);
        const vec height = passed ? over_k_root * TERM(OVER_ROOT) : (vec)(0);
        h.re = near.re - far.re + height * ridge.re;
        h.im = near.im - far.im + height * ridge.im;

        // A little more than SHORT: rounding may not hide a lane that is within.
        if (psi.all * least[block].x + alpha.all * least[block].y < REAL_C(1.0001) * SHORT) {
            const vec remains = TERM(REMAINS);
            cvec sum;
            otf_short(REAL_C(0.5) * twice_cb * remains, twice_q * remains, cube, remains, &sum);
            const ivec within = remains * high < SHORT;
            h.re = within ? sum.re : h.re;
            h.im = within ? sum.im : h.im;
        }
        otf_place(row, places[block], h.re * TERM(GAIN_RE), side * h.im * TERM(GAIN_IM));
    }
}

// otf_power's imaginary parts cancel only if its products are rounded one by one.
#pragma OPENCL FP_CONTRACT OFF

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
