// wiener.cl : the filter that undoes a known blur as far as noise allows.
//
//   G = conj(H) / (|H|^2 + nsr), and 0 where H = 0       docs/maths.md, eqs W1, W2
//
//   h_rows    (.., NY) cplx           1-D OTF along y, DC first; entry `row_entry` of a table
//   h_cols    (.., NX) cplx           1-D OTF along x, DC first; entry `col_entry` of a table
//   otf       (NY, NX / 2 + 1) cplx   H of a blur that does not separate, the half a real image needs
//   gain      (NY, NX / 2 + 1) cplx   a finished filter, only to be laid out
//   noise     (NY, NX / 2 + 1) real   noise to signal of each frequency, or null: `nsr` for all
//   order     (NY) int                frequency index of each row of the filter
//   filter    WIENER_BLOCK = 0: (NY, NX / 2 + 1) cplx
//             else (columns / WIENER_BLOCK, NY, 2, WIENER_BLOCK) real, zero beyond column NX / 2
//   ny, nx    padded frame            half: nx / 2 + 1
//   scale     1, or what the transforms leave undone
//
// One work-item per frequency; global size (columns, NY); no local memory, no barriers.
// wiener_axes takes the real part at the Nyquist index of each even axis: the half spectrum of a real image
// has no room for its sign, and a complex value there would shift that frequency by a phase of its own.
// Error: below 4 eps of |G| in float and double where H is exact (PoCL and Intel's runtime).

#include "complex.h"

#ifndef WIENER_BLOCK
#define WIENER_BLOCK 0            // columns per block of the layout; 0: plain rows of complex numbers
#endif

#if REAL_IS_DOUBLE
#define WIENER_SMALLEST 2.2250738585072014e-308
#else
#define WIENER_SMALLEST 1.17549435e-38f
#endif

static inline cplx wiener_gain(const cplx h, const real nsr)
{
    // |H|^2 underflows long before H does: divide by the larger part first.
    const real a = h.x < 0 ? -h.x : h.x, b = h.y < 0 ? -h.y : h.y, m = a > b ? a : b;
    if (m < WIENER_SMALLEST) return (cplx)(0, 0);
    const cplx unit = h / m;
    return cplx_conj(unit) / (m * cplx_abs2(unit) + nsr / m);
}

static inline void wiener_put(__global real *filter, const cplx g, const int col, const int row,
                              const int ny, const int half_columns)
{
#if WIENER_BLOCK
    const size_t start = ((size_t)(col / WIENER_BLOCK) * ny + row) * 2 * WIENER_BLOCK + col % WIENER_BLOCK;
    filter[start] = g.x;
    filter[start + WIENER_BLOCK] = g.y;
#else
    const size_t start = 2 * ((size_t)row * half_columns + col);
    filter[start] = g.x;
    filter[start + 1] = g.y;
#endif
}

__kernel void wiener_axes(
    __global const cplx *restrict h_rows,
    __global const cplx *restrict h_cols,
    __global const real *restrict noise,
    __global const int  *restrict order,
    __global real       *restrict filter,
    const int ny, const int nx, const int row_entry, const int col_entry,
    const real nsr, const real scale)
{
    const int col = get_global_id(0), row = get_global_id(1), half_columns = nx / 2 + 1;
    if (row >= ny) return;
    cplx g = (cplx)(0, 0);
    if (col < half_columns) {
        const int frequency = order[row];
        cplx v = h_rows[(size_t)row_entry * ny + frequency], u = h_cols[(size_t)col_entry * nx + col];
        if (2 * frequency == ny) v.y = 0;
        if (2 * col == nx) u.y = 0;
        g = scale * wiener_gain(cplx_mul(v, u), noise ? noise[(size_t)frequency * half_columns + col] : nsr);
    }
#if !WIENER_BLOCK
    if (col >= half_columns) return;
#endif
    wiener_put(filter, g, col, row, ny, half_columns);
}

__kernel void wiener_spectrum(
    __global const cplx *restrict otf,
    __global const real *restrict noise,
    __global const int  *restrict order,
    __global real       *restrict filter,
    const int ny, const int nx,
    const real nsr, const real scale)
{
    const int col = get_global_id(0), row = get_global_id(1), half_columns = nx / 2 + 1;
    if (row >= ny) return;
    cplx g = (cplx)(0, 0);
    if (col < half_columns) {
        const size_t i = (size_t)order[row] * half_columns + col;
        g = scale * wiener_gain(otf[i], noise ? noise[i] : nsr);
    }
#if !WIENER_BLOCK
    if (col >= half_columns) return;
#endif
    wiener_put(filter, g, col, row, ny, half_columns);
}

__kernel void wiener_arrange(
    __global const cplx *restrict gain,
    __global const int  *restrict order,
    __global real       *restrict filter,
    const int ny, const int nx,
    const real scale)
{
    const int col = get_global_id(0), row = get_global_id(1), half_columns = nx / 2 + 1;
    if (row >= ny) return;
    cplx g = (cplx)(0, 0);
    if (col < half_columns) g = scale * gain[(size_t)order[row] * half_columns + col];
#if !WIENER_BLOCK
    if (col >= half_columns) return;
#endif
    wiener_put(filter, g, col, row, ny, half_columns);
}
