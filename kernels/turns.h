// turns.h : phases in turns, one in each lane: products less their whole turns, sines and cosines.
//
//   docs/maths.md, eqs. P3 and P4. Only sums as they are written round to whole and half turns: build without
//   -cl-fast-relaxed-math or -cl-unsafe-math-optimizations. Fused multiply-adds do no harm: what must not be
//   rounded is exact without them.

#ifndef ADOF_TURNS_H
#define ADOF_TURNS_H

#include "lanes.h"
#include "two_term.h"

#if REAL_IS_DOUBLE
#define BITS       long
#define SIGN_BIT   63
#define COARSE     (~0x7ffffffL)               // keeps 26 significant bits of 53
#define WHOLE      REAL_C(6755399441055744.0)  // 1.5 * 2^52: added to a number, leaves whole ones
#else
#define BITS       int
#define SIGN_BIT   31
#define COARSE     (~0xfff)                    // keeps 12 significant bits of 24
#define WHOLE      REAL_C(12582912.0)          // 1.5 * 2^23
#endif
#define HALVES     (REAL_C(0.5) * WHOLE)

#if VECTOR_BYTES
typedef JOIN(BITS, LANES) ivec;
#define AS_IVEC(V) JOIN(as_, JOIN(BITS, LANES))(V)
#define AS_VEC(V)  JOIN(as_, JOIN(SCALAR, LANES))(V)
#else
typedef BITS ivec;
#define AS_IVEC(V) JOIN(as_, BITS)(V)
#define AS_VEC(V)  JOIN(as_, SCALAR)(V)
#endif

// A number of turns that is the same in every lane: its hi part; the leading half of that part's bits; the rest.
typedef struct { real all, coarse, fine; } turns_factor;

ALWAYS_INLINE void turns_split(const two_term turns, turns_factor *a)
{
    a->all = turns.x;
    a->coarse = JOIN(as_, SCALAR)(JOIN(as_, BITS)(turns.x) & COARSE);
    a->fine = (turns.x - a->coarse) + turns.y;
}

// a (coarse + fine) less whole turns: a few turns at most. `coarse` holds half of a real's bits.
ALWAYS_INLINE vec turns_product(const turns_factor a, const vec coarse, const vec fine)
{
    const vec p = a.coarse * coarse;   // exact
    return (p - ((p + WHOLE) - WHOLE)) + (a.all * fine + a.fine * coarse);
}

// sin(2 pi r)/r and cos(2 pi r), |r| <= 1/4: coefficients of r^0, r^2 .. Largest errors 3.4e-9 r and 2.2e-10
// (float), 9.1e-17 and 3.9e-18 (double).
#if REAL_IS_DOUBLE
#define SINE_TERMS   8
#define COSINE_TERMS 9
static __constant real turns_sine[SINE_TERMS] = {
    REAL_C(6.2831853071795805472), REAL_C(-41.341702240395150137), REAL_C(81.605249275035963735),
    REAL_C(-76.705859648118997118), REAL_C(42.058688328549285211), REAL_C(-15.094472068492531398),
    REAL_C(3.8170019838418909695), REAL_C(-0.69095444495998304174)
};
static __constant real turns_cosine[COSINE_TERMS] = {
    REAL_C(1.0), REAL_C(-19.739208802178707095), REAL_C(64.939394022663960761),
    REAL_C(-85.456817205981736255), REAL_C(60.244641313230942634), REAL_C(-26.426254069097429086),
    REAL_C(7.903462537597422519), REAL_C(-1.7132188587786943908), REAL_C(0.27194764166244960426)
};
#else
#define SINE_TERMS   5
#define COSINE_TERMS 6
static __constant real turns_sine[SINE_TERMS] = {
    REAL_C(6.28318516), REAL_C(-41.3416554), REAL_C(81.6010209), REAL_C(-76.5501079), REAL_C(39.5388697)
};
static __constant real turns_cosine[COSINE_TERMS] = {
    REAL_C(1.0), REAL_C(-19.7392085), REAL_C(64.9393466), REAL_C(-85.4535716), REAL_C(60.144015),
    REAL_C(-24.9822378)
};
#endif

// exp(2 pi i turns), |turns| below 2^20
ALWAYS_INLINE void turns_wave(const vec turns, cvec *wave)
{
    const vec halves = turns + HALVES;
    const vec r = turns - (halves - HALVES);         // in [-1/4, 1/4]
    const ivec sign = AS_IVEC(halves) << SIGN_BIT;   // set when the half turns taken away were an odd number
    const vec y = r * r;
    vec s = turns_sine[SINE_TERMS - 1], c = turns_cosine[COSINE_TERMS - 1];
    _Pragma("unroll")
    for (int i = SINE_TERMS - 2; i >= 0; --i) s = s * y + turns_sine[i];
    _Pragma("unroll")
    for (int i = COSINE_TERMS - 2; i >= 0; --i) c = c * y + turns_cosine[i];
    wave->re = AS_VEC(AS_IVEC(c) ^ sign);
    wave->im = AS_VEC(AS_IVEC(r * s) ^ sign);
}

// a becomes a exp(2 pi i turns).
ALWAYS_INLINE void turns_rotate(cvec *a, const vec turns)
{
    cvec wave;
    turns_wave(turns, &wave);
    const vec re = a->re * wave.re - a->im * wave.im;
    a->im = a->re * wave.im + a->im * wave.re;
    a->re = re;
}

#endif
