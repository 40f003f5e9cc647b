// wiener_lift.h : |H|^2 underflows long before H does, so both factors of H are scaled up by an exact power of two
// first (docs/maths.md, eq. W9).

#ifndef ADOF_WIENER_LIFT_H
#define ADOF_WIENER_LIFT_H

#include "precision.h"

#if REAL_IS_DOUBLE
#define WIENER_LIFT 1.427247692705959881e45      // 2^150
#else
#define WIENER_LIFT 1048576.0f                   // 2^20
#endif

#endif
