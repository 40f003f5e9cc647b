// wiener.cl : the filter that undoes a known blur as far as noise allows.
//
//   G = conj(H) / (|H|^2 + nsr), and 0 where H = 0       docs/maths.md, eqs. W1 and W9
//   H = 0 where |H|^2 + nsr < 8e-51 (2e-381 in double): G would end beyond the largest number.
//
//   h_rows    (.., NY) cplx           1-D OTF along y, DC first; of a table: `rows_from` on
//   h_cols    (.., NX) cplx           1-D OTF along x, DC first; of a table: `cols_from` on
//   otf       (NY, NX / 2 + 1) cplx   H of a blur that does not separate, the half a real image needs
//   gain      (NY, NX / 2 + 1) cplx   a finished filter, only to be laid out
//   noise     (NY, NX / 2 + 1) real   noise to signal of each frequency, or null: `nsr` for all
//   filter    the layout decides:
//             WIENER_BLOCK = 0    (NY, NX / 2 + 1) cplx
//             else                (shorts / WIENER_BLOCK, longs, 2, WIENER_BLOCK) real: blocks of the axis of which
//                                 half is held (x, or y where WIENER_HALF_ROWS), and the whole of the other
//   long_frequency (longs) int, short_frequency (shorts) int   frequency at each place of the two; -1: none, G = 0
//   ny, nx    padded frame            scale: 1, or what the transforms leave undone
//
// One work-item a value. No local memory, no barriers.
// wiener_axes takes the real part at the Nyquist index of each even axis: the half spectrum of a real image has no
// room for its sign, and a complex value there would shift that frequency by a phase of its own.
// Error: below 4 eps of |G| in float and double where H is exact (PoCL and Intel's runtime).

#include "complex.h"
#include "wiener_lift.h"

#ifndef WIENER_BLOCK
#define WIENER_BLOCK 0
#endif
#ifndef WIENER_HALF_ROWS
#define WIENER_HALF_ROWS 0
#endif

// G of a lifted H.
static inline cplx wiener_gain(const cplx h, const real nsr, const real scale)
{
    const real lift = WIENER_LIFT * WIENER_LIFT;
    const real power = cplx_abs2(h) + lift * (lift * nsr);
    const real share = power > REAL_LEAST ? scale * lift / power : 0;
    return share * cplx_conj(h);
}

// H at one frequency of an axis of `n`, lifted.
static inline cplx wiener_axis(__global const cplx *h, const int frequency, const int n)
{
    const cplx value = WIENER_LIFT * h[frequency];
    return 2 * frequency == n ? (cplx)(value.x, 0) : value;
}

// What the layout holds of a real image's filter at any frequency, given the half along x: the value there, or its
// mirror's conjugate; where both are given, at 0 and Nyquist, the inverse transform sees their mean.
#define WIENER_WHOLE(VALUE, Y, X)                                                                           \
    ((X) == 0 || 2 * (X) == nx                                                                              \
         ? REAL_C(0.5) * (VALUE(Y, X) + cplx_conj(VALUE(((Y) ? ny - (Y) : 0), X)))                          \
         : 2 * (X) < nx ? VALUE(Y, X) : cplx_conj(VALUE(((Y) ? ny - (Y) : 0), nx - (X))))

#if WIENER_BLOCK
#define WIENER_FORM(VALUE)                                                                                  \
    const int s = get_global_id(0), l = get_global_id(1);                                                   \
    const int y = WIENER_HALF_ROWS ? short_frequency[s] : long_frequency[l];                                \
    const int x = WIENER_HALF_ROWS ? long_frequency[l] : short_frequency[s];                                \
    cplx g = (cplx)(0, 0);                                                                                  \
    if (y >= 0 && x >= 0) g = WIENER_HALF_ROWS ? WIENER_WHOLE(VALUE, y, x) : VALUE(y, x);                   \
    const size_t at = ((size_t)(s / WIENER_BLOCK) * get_global_size(1) + l) * 2 * WIENER_BLOCK + s % WIENER_BLOCK; \
    filter[at] = g.x;                                                                                       \
    filter[at + WIENER_BLOCK] = g.y;
#else
#define WIENER_FORM(VALUE)                                                                                  \
    const int x = get_global_id(0), y = get_global_id(1);                                                   \
    const cplx g = VALUE(y, x);                                                                             \
    filter[2 * (y * (nx / 2 + 1) + x)] = g.x;                                                               \
    filter[2 * (y * (nx / 2 + 1) + x) + 1] = g.y;
#endif

#define WIENER_AT(Y, X)    ((size_t)(Y) * (nx / 2 + 1) + (X))
#define WIENER_NOISE(Y, X) (noise ? noise[WIENER_AT(Y, X)] : nsr)

__kernel void wiener_axes(
    __global const cplx *restrict h_rows,
    __global const cplx *restrict h_cols,
    __global const real *restrict noise,
    __global const int  *restrict long_frequency,
    __global const int  *restrict short_frequency,
    __global real       *restrict filter,
    const int ny, const int nx, const int rows_from, const int cols_from,
    const real nsr, const real scale)
{
#define WIENER_OF_AXES(Y, X)                                                                                \
    wiener_gain(cplx_mul(wiener_axis(h_rows + rows_from, Y, ny), wiener_axis(h_cols + cols_from, X, nx)),   \
                WIENER_NOISE(Y, X), scale)
    WIENER_FORM(WIENER_OF_AXES)
}

__kernel void wiener_spectrum(
    __global const cplx *restrict otf,
    __global const real *restrict noise,
    __global const int  *restrict long_frequency,
    __global const int  *restrict short_frequency,
    __global real       *restrict filter,
    const int ny, const int nx,
    const real nsr, const real scale)
{
#define WIENER_OF_SPECTRUM(Y, X) \
    wiener_gain(WIENER_LIFT * WIENER_LIFT * otf[WIENER_AT(Y, X)], WIENER_NOISE(Y, X), scale)
    WIENER_FORM(WIENER_OF_SPECTRUM)
}

__kernel void wiener_arrange(
    __global const cplx *restrict gain,
    __global const int  *restrict long_frequency,
    __global const int  *restrict short_frequency,
    __global real       *restrict filter,
    const int ny, const int nx,
    const real scale)
{
#define WIENER_OF_GAIN(Y, X) (scale * gain[WIENER_AT(Y, X)])
    WIENER_FORM(WIENER_OF_GAIN)
}
