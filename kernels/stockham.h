// stockham.h : one pass of a radix-2 Fourier transform that sorts itself; powers of two, set-up work only.
//
//   y[q + s (2 p)]     = x[q + s p] + x[q + s (p + m)]
//   y[q + s (2 p + 1)] = (x[q + s p] - x[q + s (p + m)]) exp(-+ 2 pi i p s / n)
//
// for s = 1, 2, 4 .. n/2, m = n/(2 s), p < m, q < s; unscaled. Stockham's order, after Cochran et al., Proc. IEEE
// 55, 1664 (1967).

#ifndef ADOF_STOCKHAM_H
#define ADOF_STOCKHAM_H

#include "complex.h"

// x, y     one line each begins at `first`, its samples `step` apart; x and y must not overlap
// roots    (n/2) cplx   exp(-2 pi i k / n)
// butterfly j of n/2
// sign     -1 forward, +1 inverse
static inline void stockham_pass(
    __global const cplx *x, __global cplx *y, __global const cplx *roots,
    const int first, const int step, const int n, const int s, const int j, const int sign)
{
    const int p = j / s, q = j - p * s;
    const cplx a = x[first + step * j];                 // q + s p is j itself
    const cplx b = x[first + step * (j + n / 2)];
    cplx root = roots[p * s];
    if (sign > 0) root.y = -root.y;
    const int to = first + step * (q + 2 * s * p);
    y[to] = a + b;
    const cplx d = a - b;
    // The product in whole vectors: Oclgrind's compiler splits the store of one built from two scalars.
    y[to + step * s] = d.xx * root + d.yy * (cplx)(-root.y, root.x);
}

#endif
