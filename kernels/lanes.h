// lanes.h : vectors as wide as the registers the compiler uses, one problem in each lane.
//
//   VECTOR_BYTES   16, 32 or 64, which program.vector_bytes finds; 0, the default: one real, for a work-item that
//                  does one problem
//   vec            that many bytes of reals;   LANES how many;   SCALAR their type's name
//   JOIN(A, B)     joins two names after expanding them: JOIN(uchar, LANES)
//   cvec           complex numbers, one in each lane
//   CONVERT(V, T)  a vector to elements of type T
//   ALWAYS_INLINE  for helpers: a plain `inline` becomes a call through memory on some compilers
//   WIDE           for kernels: without it LLVM halves vectors of 64 bytes even where the registers hold them
//   PORTABLE       1: only what OpenCL C 1.2 itself offers

#ifndef ADOF_LANES_H
#define ADOF_LANES_H

#include "precision.h"

#ifndef VECTOR_BYTES
#define VECTOR_BYTES 0
#endif
#ifndef PORTABLE
#define PORTABLE 0
#endif
#ifndef __has_builtin
#define __has_builtin(X) 0
#endif
#ifndef __has_attribute
#define __has_attribute(X) 0
#endif

#define JOIN_(A, B) A##B
#define JOIN(A, B)  JOIN_(A, B)

#if REAL_IS_DOUBLE
#define SCALAR double
#define LANES_OF(BYTES) (BYTES / 8)
#else
#define SCALAR float
#define LANES_OF(BYTES) (BYTES / 4)
#endif

#if VECTOR_BYTES == 0
#define LANES 1
typedef real vec;
#elif LANES_OF(VECTOR_BYTES) == 2
#define LANES 2
#elif LANES_OF(VECTOR_BYTES) == 4
#define LANES 4
#elif LANES_OF(VECTOR_BYTES) == 8
#define LANES 8
#elif LANES_OF(VECTOR_BYTES) == 16
#define LANES 16
#else
#error "VECTOR_BYTES is 0, 16, 32 or 64"
#endif
#if VECTOR_BYTES
typedef JOIN(SCALAR, LANES) vec;
#endif

typedef struct { vec re, im; } cvec;

// OpenCL's convert_ functions are calls on some compilers, a vector conversion is one instruction.
#if VECTOR_BYTES == 0
#define CONVERT(V, TYPE) ((TYPE)(V))
#elif __has_builtin(__builtin_convertvector) && !PORTABLE
#define CONVERT(V, TYPE) __builtin_convertvector(V, JOIN(TYPE, LANES))
#else
#define CONVERT(V, TYPE) JOIN(JOIN(convert_, TYPE), LANES)(V)
#endif

#define ALWAYS_INLINE static inline __attribute__((always_inline))

#if __has_attribute(min_vector_width) && VECTOR_BYTES == 64
#define WIDE __attribute__((min_vector_width(512)))
#else
#define WIDE
#endif

#endif
