// restore_transpose.h : a square of LANES vectors of LANES reals, rows to columns, in registers.
//
//   v    LANES vectors of type `vec`, 64 bytes each; v[i].lane[j] becomes v[j].lane[i]
//
// Two rounds interleave inside lanes of 128 bits, two move those lanes: every step is one instruction on
// AVX-512 and two on AVX2. A literal (float16)(a.s0, b.s0, ...) compiles to three times as many, and
// OpenCL's own shuffle2 to a call. Without the compiler's shuffle the squares go through memory.

#ifndef ADOF_RESTORE_TRANSPOSE_H
#define ADOF_RESTORE_TRANSPOSE_H

#ifndef RESTORE_LANES
#define RESTORE_LANES 1
#endif
#ifndef RESTORE_PORTABLE
#define RESTORE_PORTABLE 0        // 1: only what OpenCL C 1.2 itself offers
#endif

#include "restore_vectors.h"

#ifdef __has_builtin
#if __has_builtin(__builtin_shufflevector) && LANES > 1 && !RESTORE_PORTABLE
#define RESTORE_SHUFFLES 1
#endif
#endif

#ifdef RESTORE_SHUFFLES

#define RESTORE_MIX(A, B, ...) __builtin_shufflevector(A, B, __VA_ARGS__)

#if REAL_IS_DOUBLE
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 8, 2, 10, 4, 12, 6, 14)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 1, 9, 3, 11, 5, 13, 7, 15)
#define RESTORE_LANE_EVEN(A, B) RESTORE_MIX(A, B, 0, 1, 4, 5, 8, 9, 12, 13)
#define RESTORE_LANE_ODD(A, B)  RESTORE_MIX(A, B, 2, 3, 6, 7, 10, 11, 14, 15)
#else
#define RESTORE_ONE_LOW(A, B)   RESTORE_MIX(A, B, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29)
#define RESTORE_ONE_HIGH(A, B)  RESTORE_MIX(A, B, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31)
#define RESTORE_PAIR_LOW(A, B)  RESTORE_MIX(A, B, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
#define RESTORE_PAIR_HIGH(A, B) RESTORE_MIX(A, B, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31)
#define RESTORE_LANE_EVEN(A, B) RESTORE_MIX(A, B, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
#define RESTORE_LANE_ODD(A, B)  RESTORE_MIX(A, B, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31)
#endif

// Four vectors, one per group of rows, each with four 128-bit lanes: lanes to vectors.
RESTORE_INLINE void restore_turn_lanes(vec *v, const int first, const int step,
                                       const vec a, const vec b, const vec c, const vec d)
{
    const vec ab_even = RESTORE_LANE_EVEN(a, b), ab_odd = RESTORE_LANE_ODD(a, b);
    const vec cd_even = RESTORE_LANE_EVEN(c, d), cd_odd = RESTORE_LANE_ODD(c, d);
    v[first]            = RESTORE_LANE_EVEN(ab_even, cd_even);
    v[first + step]     = RESTORE_LANE_EVEN(ab_odd, cd_odd);
    v[first + 2 * step] = RESTORE_LANE_ODD(ab_even, cd_even);
    v[first + 3 * step] = RESTORE_LANE_ODD(ab_odd, cd_odd);
}

#if REAL_IS_DOUBLE
RESTORE_INLINE void restore_transpose(vec *v)
{
    vec t[8];
    _Pragma("unroll")
    for (int g = 0; g < 8; g += 2) {
        t[g]     = RESTORE_PAIR_LOW(v[g], v[g + 1]);
        t[g + 1] = RESTORE_PAIR_HIGH(v[g], v[g + 1]);
    }
    _Pragma("unroll")
    for (int c = 0; c < 2; ++c) restore_turn_lanes(v, c, 2, t[c], t[2 + c], t[4 + c], t[6 + c]);
}
#else
RESTORE_INLINE void restore_transpose(vec *v)
{
    vec t[16];
    _Pragma("unroll")
    for (int g = 0; g < 16; g += 4) {
        const vec ll = RESTORE_ONE_LOW(v[g], v[g + 1]), lh = RESTORE_ONE_LOW(v[g + 2], v[g + 3]);
        const vec hl = RESTORE_ONE_HIGH(v[g], v[g + 1]), hh = RESTORE_ONE_HIGH(v[g + 2], v[g + 3]);
        t[g]     = RESTORE_PAIR_LOW(ll, lh);
        t[g + 1] = RESTORE_PAIR_HIGH(ll, lh);
        t[g + 2] = RESTORE_PAIR_LOW(hl, hh);
        t[g + 3] = RESTORE_PAIR_HIGH(hl, hh);
    }
    _Pragma("unroll")
    for (int c = 0; c < 4; ++c) restore_turn_lanes(v, c, 4, t[c], t[4 + c], t[8 + c], t[12 + c]);
}
#endif

#else

RESTORE_INLINE void restore_transpose(vec *v)
{
    real square[LANES * LANES];
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < LANES; ++j) square[j * LANES + i] = ((const real *)&v[i])[j];
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < LANES; ++j) ((real *)&v[i])[j] = square[i * LANES + j];
}

#endif
#endif
