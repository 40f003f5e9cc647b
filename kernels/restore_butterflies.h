// restore_butterflies.h : small forward transforms, in place, in natural order.
//
//   X[k] = sum_n x[n] exp(-2 pi i n k / R)              docs/maths.md, eq. W5
//
//   xr, xi   R values each: real and imaginary parts, of one transform or of one in each lane
//
// The inverse (unscaled) of every one is itself with xr and xi exchanged.
// R = 2, 3, 4, 5, 7, 8 and 9 are written out; 6, 10, 12 and 15 join coprime factors by index maps alone
// (Good and Thomas), so they need no inner twiddles.

#ifndef ADOF_RESTORE_BUTTERFLIES_H
#define ADOF_RESTORE_BUTTERFLIES_H

#include "lanes.h"

ALWAYS_INLINE void restore_radix2(vec *xr, vec *xi)
{
    const vec r = xr[0] - xr[1], i = xi[0] - xi[1];
    xr[0] += xr[1];
    xi[0] += xi[1];
    xr[1] = r;
    xi[1] = i;
}

ALWAYS_INLINE void restore_radix3(vec *xr, vec *xi)
{
    const real half_width = REAL_C(0.86602540378443864676);   // sin(2 pi / 3)
    const vec sr = xr[1] + xr[2], si = xi[1] + xi[2];
    const vec dr = half_width * (xr[1] - xr[2]), di = half_width * (xi[1] - xi[2]);
    const vec mr = xr[0] - REAL_C(0.5) * sr, mi = xi[0] - REAL_C(0.5) * si;
    xr[0] += sr;
    xi[0] += si;
    xr[1] = mr + di;
    xi[1] = mi - dr;
    xr[2] = mr - di;
    xi[2] = mi + dr;
}

ALWAYS_INLINE void restore_radix4(vec *xr, vec *xi)
{
    const vec ar = xr[0] + xr[2], ai = xi[0] + xi[2], br = xr[0] - xr[2], bi = xi[0] - xi[2];
    const vec cr = xr[1] + xr[3], ci = xi[1] + xi[3], dr = xr[1] - xr[3], di = xi[1] - xi[3];
    xr[0] = ar + cr;
    xi[0] = ai + ci;
    xr[1] = br + di;
    xi[1] = bi - dr;
    xr[2] = ar - cr;
    xi[2] = ai - ci;
    xr[3] = br - di;
    xi[3] = bi + dr;
}

ALWAYS_INLINE void restore_radix5(vec *xr, vec *xi)
{
    const real c1 = REAL_C(0.30901699437494742410), c2 = REAL_C(-0.80901699437494742410);
    const real s1 = REAL_C(0.95105651629515357212), s2 = REAL_C(0.58778525229247312917);
    const vec ar = xr[1] + xr[4], ai = xi[1] + xi[4], br = xr[1] - xr[4], bi = xi[1] - xi[4];
    const vec cr = xr[2] + xr[3], ci = xi[2] + xi[3], dr = xr[2] - xr[3], di = xi[2] - xi[3];
    const vec m1r = xr[0] + c1 * ar + c2 * cr, m1i = xi[0] + c1 * ai + c2 * ci;
    const vec m2r = xr[0] + c2 * ar + c1 * cr, m2i = xi[0] + c2 * ai + c1 * ci;
    const vec n1r = s1 * br + s2 * dr, n1i = s1 * bi + s2 * di;
    const vec n2r = s2 * br - s1 * dr, n2i = s2 * bi - s1 * di;
    xr[0] += ar + cr;
    xi[0] += ai + ci;
    xr[1] = m1r + n1i;
    xi[1] = m1i - n1r;
    xr[2] = m2r + n2i;
    xi[2] = m2i - n2r;
    xr[3] = m2r - n2i;
    xi[3] = m2i + n2r;
    xr[4] = m1r - n1i;
    xi[4] = m1i + n1r;
}

ALWAYS_INLINE void restore_radix7(vec *xr, vec *xi)
{
    const real c1 = REAL_C(0.62348980185873353053), c2 = REAL_C(-0.22252093395631440429);
    const real c3 = REAL_C(-0.90096886790241912624), s1 = REAL_C(0.78183148246802980871);
    const real s2 = REAL_C(0.97492791218182360702), s3 = REAL_C(0.43388373911755812048);
    const vec ar = xr[1] + xr[6], ai = xi[1] + xi[6], br = xr[1] - xr[6], bi = xi[1] - xi[6];
    const vec cr = xr[2] + xr[5], ci = xi[2] + xi[5], dr = xr[2] - xr[5], di = xi[2] - xi[5];
    const vec er = xr[3] + xr[4], ei = xi[3] + xi[4], fr = xr[3] - xr[4], fi = xi[3] - xi[4];
    const vec m1r = xr[0] + c1 * ar + c2 * cr + c3 * er, m1i = xi[0] + c1 * ai + c2 * ci + c3 * ei;
    const vec m2r = xr[0] + c2 * ar + c3 * cr + c1 * er, m2i = xi[0] + c2 * ai + c3 * ci + c1 * ei;
    const vec m3r = xr[0] + c3 * ar + c1 * cr + c2 * er, m3i = xi[0] + c3 * ai + c1 * ci + c2 * ei;
    const vec n1r = s1 * br + s2 * dr + s3 * fr, n1i = s1 * bi + s2 * di + s3 * fi;
    const vec n2r = s2 * br - s3 * dr - s1 * fr, n2i = s2 * bi - s3 * di - s1 * fi;
    const vec n3r = s3 * br - s1 * dr + s2 * fr, n3i = s3 * bi - s1 * di + s2 * fi;
    xr[0] += ar + cr + er;
    xi[0] += ai + ci + ei;
    xr[1] = m1r + n1i;
    xi[1] = m1i - n1r;
    xr[2] = m2r + n2i;
    xi[2] = m2i - n2r;
    xr[3] = m3r + n3i;
    xi[3] = m3i - n3r;
    xr[4] = m3r - n3i;
    xi[4] = m3i + n3r;
    xr[5] = m2r - n2i;
    xi[5] = m2i + n2r;
    xr[6] = m1r - n1i;
    xi[6] = m1i + n1r;
}

ALWAYS_INLINE void restore_radix8(vec *xr, vec *xi)
{
    const real h = REAL_C(0.70710678118654752440);
    vec er[4] = {xr[0], xr[2], xr[4], xr[6]}, ei[4] = {xi[0], xi[2], xi[4], xi[6]};
    vec gr[4] = {xr[1], xr[3], xr[5], xr[7]}, gi[4] = {xi[1], xi[3], xi[5], xi[7]};
    restore_radix4(er, ei);
    restore_radix4(gr, gi);
    const vec t1r = h * (gr[1] + gi[1]), t1i = h * (gi[1] - gr[1]);
    const vec t3r = h * (gi[3] - gr[3]), t3i = -h * (gr[3] + gi[3]);
    xr[0] = er[0] + gr[0];
    xi[0] = ei[0] + gi[0];
    xr[1] = er[1] + t1r;
    xi[1] = ei[1] + t1i;
    xr[2] = er[2] + gi[2];
    xi[2] = ei[2] - gr[2];
    xr[3] = er[3] + t3r;
    xi[3] = ei[3] + t3i;
    xr[4] = er[0] - gr[0];
    xi[4] = ei[0] - gi[0];
    xr[5] = er[1] - t1r;
    xi[5] = ei[1] - t1i;
    xr[6] = er[2] - gi[2];
    xi[6] = ei[2] + gr[2];
    xr[7] = er[3] - t3r;
    xi[7] = ei[3] - t3i;
}

// (xr + i xi) times (c - i s): one inner twiddle of radix 9.
#define RESTORE_TURN(K, C, S)                                 \
    {                                                         \
        const vec turned = xr[K] * REAL_C(C) + xi[K] * REAL_C(S); \
        xi[K] = xi[K] * REAL_C(C) - xr[K] * REAL_C(S);        \
        xr[K] = turned;                                       \
    }

ALWAYS_INLINE void restore_radix9(vec *xr, vec *xi)
{
    vec ar[3] = {xr[0], xr[3], xr[6]}, ai[3] = {xi[0], xi[3], xi[6]};
    vec br[3] = {xr[1], xr[4], xr[7]}, bi[3] = {xi[1], xi[4], xi[7]};
    vec cr[3] = {xr[2], xr[5], xr[8]}, ci[3] = {xi[2], xi[5], xi[8]};
    restore_radix3(ar, ai);
    restore_radix3(br, bi);
    restore_radix3(cr, ci);
    xr[4] = br[1];
    xi[4] = bi[1];
    xr[5] = br[2];
    xi[5] = bi[2];
    xr[7] = cr[1];
    xi[7] = ci[1];
    xr[8] = cr[2];
    xi[8] = ci[2];
    RESTORE_TURN(4, 0.76604444311897803520, 0.64278760968653932632)
    RESTORE_TURN(5, 0.17364817766693034885, 0.98480775301220805937)
    RESTORE_TURN(7, 0.17364817766693034885, 0.98480775301220805937)
    RESTORE_TURN(8, -0.93969262078590838405, 0.34202014332566873304)
    vec dr[3] = {ar[0], br[0], cr[0]}, di[3] = {ai[0], bi[0], ci[0]};
    vec er[3] = {ar[1], xr[4], xr[7]}, ei[3] = {ai[1], xi[4], xi[7]};
    vec fr[3] = {ar[2], xr[5], xr[8]}, fi[3] = {ai[2], xi[5], xi[8]};
    restore_radix3(dr, di);
    restore_radix3(er, ei);
    restore_radix3(fr, fi);
    for (int q = 0; q < 3; ++q) {
        xr[3 * q] = dr[q];
        xi[3 * q] = di[q];
        xr[3 * q + 1] = er[q];
        xi[3 * q + 1] = ei[q];
        xr[3 * q + 2] = fr[q];
        xi[3 * q + 2] = fi[q];
    }
}

// Coprime P, Q: input n = (Q a + P b) mod PQ, output k = (U a + V b) mod PQ with U = 1 mod P, 0 mod Q and
// V = 0 mod P, 1 mod Q.
#define RESTORE_COPRIME(N, P, Q, U, V)                              \
    ALWAYS_INLINE void restore_radix##N(vec *xr, vec *xi)          \
    {                                                               \
        vec tr[N], ti[N];                                           \
        _Pragma("unroll")                                           \
        for (int b = 0; b < Q; ++b) {                               \
            _Pragma("unroll")                                       \
            for (int a = 0; a < P; ++a) {                           \
                tr[b * P + a] = xr[(Q * a + P * b) % N];            \
                ti[b * P + a] = xi[(Q * a + P * b) % N];            \
            }                                                       \
            restore_radix##P(tr + b * P, ti + b * P);               \
        }                                                           \
        _Pragma("unroll")                                           \
        for (int a = 0; a < P; ++a) {                               \
            vec ur[Q], ui[Q];                                       \
            _Pragma("unroll")                                       \
            for (int b = 0; b < Q; ++b) {                           \
                ur[b] = tr[b * P + a];                              \
                ui[b] = ti[b * P + a];                              \
            }                                                       \
            restore_radix##Q(ur, ui);                               \
            _Pragma("unroll")                                       \
            for (int b = 0; b < Q; ++b) {                           \
                xr[(U * a + V * b) % N] = ur[b];                    \
                xi[(U * a + V * b) % N] = ui[b];                    \
            }                                                       \
        }                                                           \
    }

RESTORE_COPRIME(6, 2, 3, 3, 4)
RESTORE_COPRIME(10, 2, 5, 5, 6)
RESTORE_COPRIME(12, 4, 3, 9, 4)
RESTORE_COPRIME(15, 3, 5, 10, 6)

#endif
