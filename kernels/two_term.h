// two_term.h : unevaluated sums hi + lo of two reals, twice the precision of one, without fp64.
//
//   docs/maths.md, eq. P2. Knuth's sum and the fma product; Dekker, Numer. Math. 18, 224 (1971).
//   |lo| <= ulp(hi)/2 after every function. Sums and products err by at most 4 and 8 squares of eps, relative.
//
// Needs correctly rounded + - * and fma: build without -cl-fast-relaxed-math, -cl-unsafe-math-optimizations
// or -cl-mad-enable.

#ifndef ADOF_TWO_TERM_H
#define ADOF_TWO_TERM_H

#include "precision.h"

#pragma OPENCL FP_CONTRACT OFF

typedef real2 two_term;   // .x hi, .y lo

// |a| >= |b|
static inline two_term two_term_ordered(const real a, const real b)
{
    const real sum = a + b;
    return (two_term)(sum, b - (sum - a));
}

static inline two_term two_term_sum(const real a, const real b)
{
    const real sum = a + b;
    const real t = sum - a;
    return (two_term)(sum, (a - (sum - t)) + (b - t));
}

static inline two_term two_term_add(const two_term a, const two_term b)
{
    const two_term s = two_term_sum(a.x, b.x);
    return two_term_ordered(s.x, s.y + (a.y + b.y));
}

static inline two_term two_term_mul(const two_term a, const two_term b)
{
    const real p = a.x * b.x;
    const real e = fma(a.x, b.x, -p);
    return two_term_ordered(p, e + (a.x * b.y + a.y * b.x));
}

// a times a power of two or a small integer that leaves both products exact
static inline two_term two_term_scale(const two_term a, const real exact)
{
    return (two_term)(a.x * exact, a.y * exact);
}

static inline two_term two_term_div(const two_term a, const two_term b)
{
    const real q = a.x / b.x;
    const two_term rest = two_term_add(a, two_term_scale(two_term_mul(b, (two_term)(q, 0)), -1));
    return two_term_ordered(q, rest.x / b.x);
}

// The part of `turns` beyond whole turns, in [-1/2, 1/2] up to rounding.
static inline real two_term_fraction(const two_term turns)
{
    const real f = (turns.x - rint(turns.x)) + turns.y;   // the difference is exact
    return f - rint(f);
}

// exp(2 pi i turns)
static inline real2 turns_cis(const real turns)
{
    return (real2)(cospi(2 * turns), sinpi(2 * turns));
}

#endif
