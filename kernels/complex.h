// complex.h : products and moduli of cplx (see precision.h).

#ifndef ADOF_COMPLEX_H
#define ADOF_COMPLEX_H

#include "precision.h"

static inline cplx cplx_mul(const cplx a, const cplx b)
{
    return (cplx)(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x);
}

static inline cplx cplx_conj(const cplx a) { return (cplx)(a.x, -a.y); }

static inline real cplx_abs2(const cplx a) { return a.x * a.x + a.y * a.y; }

#endif
