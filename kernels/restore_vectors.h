// restore_vectors.h : what a work-item of the restoration computes with.
//
//   RESTORE_LANES   0, the default: one real; 1: 64 bytes of reals, one transform to each
//   vec             that type; LANES, and SCALAR, its element's name
//   RESTORE_INLINE  for helpers: a plain `inline` becomes a call through memory on some compilers

#ifndef ADOF_RESTORE_VECTORS_H
#define ADOF_RESTORE_VECTORS_H

#include "precision.h"

#ifndef RESTORE_LANES
#define RESTORE_LANES 0
#endif

#define RESTORE_INLINE static inline __attribute__((always_inline))

#if !RESTORE_LANES
#define LANES 1
typedef real vec;
#elif REAL_IS_DOUBLE
#define LANES  8
#define SCALAR double
typedef double8 vec;
#else
#define LANES  16
#define SCALAR float
typedef float16 vec;
#endif

#endif
