// phase_turns.h : a pupil phase polynomial along one axis, in turns, without losing its fraction.
//
//   tilt t + psi t^2 + alpha t^3, all over 2 pi            docs/maths.md, eqs. P1 and P2

#ifndef ADOF_PHASE_TURNS_H
#define ADOF_PHASE_TURNS_H

#include "two_term.h"

// Fraction of a turn, in [-1/2, 1/2]; coefficients in turns.
static inline real phase_turns(const two_term t, const two_term tilt, const two_term psi, const two_term alpha)
{
    const two_term linear = two_term_add(two_term_mul(alpha, t), psi);
    const two_term slope = two_term_add(two_term_mul(linear, t), tilt);
    return two_term_fraction(two_term_mul(slope, t));
}

// Any sum of a few fractions, wrapped to [0, 1).
static inline real turns_wrap(const real turns)
{
    const real f = turns - floor(turns);
    return f < 1 ? f : 0;   // -1e-9 wraps to 1 after rounding
}

#endif
