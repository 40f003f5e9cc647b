// restore_transpose.h : a square of LANES vectors of LANES reals, rows to columns, in registers.
//
//   v    LANES vectors; v[i].lane[j] becomes v[j].lane[i]
//
// First squares inside lanes of 128 bits (two rounds of float, one of double), then those lanes change places
// (two rounds of four, one of two, none): every step is one instruction. A literal (float16)(a.s0, b.s0, ...)
// compiles to three times as many, and OpenCL's own shuffle2 to a call. Without the compiler's shuffle the
// squares go through memory.

#ifndef ADOF_RESTORE_TRANSPOSE_H
#define ADOF_RESTORE_TRANSPOSE_H

#include "lanes.h"

#if __has_builtin(__builtin_shufflevector) && VECTOR_BYTES && !PORTABLE

#define RESTORE_MIX(A, B, ...) __builtin_shufflevector(A, B, __VA_ARGS__)

#define RESTORE_CELL (4 / (1 + REAL_IS_DOUBLE))     // reals in 128 bits

// Of each 128 bits of A and B: the first or second half, interleaved by one real or by two.
#if REAL_IS_DOUBLE && VECTOR_BYTES == 64
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 8, 2, 10, 4, 12, 6, 14)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 1, 9, 3, 11, 5, 13, 7, 15)
#elif REAL_IS_DOUBLE && VECTOR_BYTES == 32
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 4, 2, 6)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 1, 5, 3, 7)
#elif REAL_IS_DOUBLE
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 2)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 1, 3)
#elif VECTOR_BYTES == 64
#define RESTORE_ONE_LOW(A, B)   RESTORE_MIX(A, B, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29)
#define RESTORE_ONE_HIGH(A, B)  RESTORE_MIX(A, B, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31)
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31)
#elif VECTOR_BYTES == 32
#define RESTORE_ONE_LOW(A, B)   RESTORE_MIX(A, B, 0, 8, 1, 9, 4, 12, 5, 13)
#define RESTORE_ONE_HIGH(A, B)  RESTORE_MIX(A, B, 2, 10, 3, 11, 6, 14, 7, 15)
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 1, 8, 9, 4, 5, 12, 13)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 2, 3, 10, 11, 6, 7, 14, 15)
#else
#define RESTORE_ONE_LOW(A, B)   RESTORE_MIX(A, B, 0, 4, 1, 5)
#define RESTORE_ONE_HIGH(A, B)  RESTORE_MIX(A, B, 2, 6, 3, 7)
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 1, 4, 5)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 2, 3, 6, 7)
#endif

// The 128-bit lanes of A and B, even ones or odd ones; of two lanes each: the first or the second.
#if VECTOR_BYTES == 64 && REAL_IS_DOUBLE
#define RESTORE_LANE_EVEN(A, B) RESTORE_MIX(A, B, 0, 1, 4, 5, 8, 9, 12, 13)
#define RESTORE_LANE_ODD(A, B)  RESTORE_MIX(A, B, 2, 3, 6, 7, 10, 11, 14, 15)
#elif VECTOR_BYTES == 64
#define RESTORE_LANE_EVEN(A, B) RESTORE_MIX(A, B, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
#define RESTORE_LANE_ODD(A, B)  RESTORE_MIX(A, B, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31)
#elif REAL_IS_DOUBLE
#define RESTORE_LANE_EVEN(A, B) RESTORE_MIX(A, B, 0, 1, 4, 5)
#define RESTORE_LANE_ODD(A, B)  RESTORE_MIX(A, B, 2, 3, 6, 7)
#else
#define RESTORE_LANE_EVEN(A, B) RESTORE_MIX(A, B, 0, 1, 2, 3, 8, 9, 10, 11)
#define RESTORE_LANE_ODD(A, B)  RESTORE_MIX(A, B, 4, 5, 6, 7, 12, 13, 14, 15)
#endif

ALWAYS_INLINE void restore_transpose(vec *v)
{
    vec t[LANES];
    _Pragma("unroll")
    for (int g = 0; g < LANES; g += RESTORE_CELL) {
#if REAL_IS_DOUBLE
        t[g]     = RESTORE_PAIR_LOW(v[g], v[g + 1]);
        t[g + 1] = RESTORE_PAIR_HIGH(v[g], v[g + 1]);
#else
        const vec ll = RESTORE_ONE_LOW(v[g], v[g + 1]), lh = RESTORE_ONE_LOW(v[g + 2], v[g + 3]);
        const vec hl = RESTORE_ONE_HIGH(v[g], v[g + 1]), hh = RESTORE_ONE_HIGH(v[g + 2], v[g + 3]);
        t[g]     = RESTORE_PAIR_LOW(ll, lh);
        t[g + 1] = RESTORE_PAIR_HIGH(ll, lh);
        t[g + 2] = RESTORE_PAIR_LOW(hl, hh);
        t[g + 3] = RESTORE_PAIR_HIGH(hl, hh);
#endif
    }
    _Pragma("unroll")
    for (int c = 0; c < RESTORE_CELL; ++c) {
#if VECTOR_BYTES == 64
        const vec a = t[c], b = t[RESTORE_CELL + c], d = t[2 * RESTORE_CELL + c], e = t[3 * RESTORE_CELL + c];
        const vec ab_even = RESTORE_LANE_EVEN(a, b), ab_odd = RESTORE_LANE_ODD(a, b);
        const vec de_even = RESTORE_LANE_EVEN(d, e), de_odd = RESTORE_LANE_ODD(d, e);
        v[c]                    = RESTORE_LANE_EVEN(ab_even, de_even);
        v[RESTORE_CELL + c]     = RESTORE_LANE_EVEN(ab_odd, de_odd);
        v[2 * RESTORE_CELL + c] = RESTORE_LANE_ODD(ab_even, de_even);
        v[3 * RESTORE_CELL + c] = RESTORE_LANE_ODD(ab_odd, de_odd);
#elif VECTOR_BYTES == 32
        v[c]                = RESTORE_LANE_EVEN(t[c], t[RESTORE_CELL + c]);
        v[RESTORE_CELL + c] = RESTORE_LANE_ODD(t[c], t[RESTORE_CELL + c]);
#else
        v[c] = t[c];
#endif
    }
}

#else

ALWAYS_INLINE void restore_transpose(vec *v)
{
    real square[LANES * LANES];
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < LANES; ++j) square[j * LANES + i] = ((const real *)&v[i])[j];
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < LANES; ++j) ((real *)&v[i])[j] = square[i * LANES + j];
}

#endif
#endif
