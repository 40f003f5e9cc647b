// wiener.cl : the filter that undoes a known blur as far as noise allows.
//
//   G = conj(H) / (|H|^2 + nsr), and 0 where H = 0       docs/maths.md, eq. W1
//
//   h_rows    (.., NY) cplx           1-D OTF along y, DC first; entry `row_entry` of a table
//   h_cols    (.., NX) cplx           1-D OTF along x, DC first; entry `col_entry` of a table
//   otf       (NY, NX / 2 + 1) cplx   H of a blur that does not separate, the half a real image needs
//   gain      (NY, NX / 2 + 1) cplx   a finished filter, only to be laid out
//   noise     (NY, NX / 2 + 1) real   noise to signal of each frequency, or null: `nsr` for all
//   order     (NY) int                frequency index of each row of the filter
//   filter    WIENER_BLOCK = 0: (NY, NX / 2 + 1) cplx
//             else (columns / WIENER_BLOCK, NY, 2, WIENER_BLOCK) real, zero beyond column NX / 2
//   ny, nx    padded frame            scale: 1, or what the transforms leave undone
//
// A work-item forms WIENER_RUN neighbouring columns of every get_global_size(1)-th row: one for a GPU, a whole
// block in SIMD lanes for a CPU. No local memory, no barriers.
// wiener_axes takes the real part at the Nyquist index of each even axis: the half spectrum of a real image
// has no room for its sign, and a complex value there would shift that frequency by a phase of its own.
// Error: below 4 eps of |G| in float and double where H is exact (PoCL and Intel's runtime).

#include "complex.h"

#ifndef WIENER_BLOCK
#define WIENER_BLOCK 0            // columns per block of the layout; 0: plain rows of complex numbers
#endif
#ifndef WIENER_RUN
#define WIENER_RUN 1              // columns per work-item; divides WIENER_BLOCK
#endif

// |H|^2 underflows long before H does, so H is scaled up by an exact power of two first.
#if REAL_IS_DOUBLE
#define WIENER_LIFT 2.037035976334486e90     // 2^300
#else
#define WIENER_LIFT 1.099511627776e12f       // 2^40
#endif

typedef struct { real re[WIENER_RUN], im[WIENER_RUN]; } wiener_run;

// Turn a run of H into a run of G in place; `level` is nsr of each.
static inline __attribute__((always_inline)) void wiener_gain(wiener_run *h, const real *level,
                                                              const real scale)
{
    for (int i = 0; i < WIENER_RUN; ++i) {
        const real x = WIENER_LIFT * h->re[i], y = WIENER_LIFT * h->im[i];
        const real power = x * x + y * y + WIENER_LIFT * (WIENER_LIFT * level[i]);
        const real share = power > 0 ? scale * WIENER_LIFT / power : 0;
        h->re[i] = share * x;
        h->im[i] = -share * y;
    }
}

static inline __attribute__((always_inline)) void wiener_level(real *level, __global const real *noise,
                                                               const real nsr, const size_t start,
                                                               const int held)
{
    // Not a loop up to `held`: Intel's runtime 2026.2 then reads one element further on where the run is 1.
    if (noise)
        for (int i = 0; i < WIENER_RUN; ++i) level[i] = i < held ? noise[start + i] : 0;
    else
        for (int i = 0; i < WIENER_RUN; ++i) level[i] = nsr;
}

static inline __attribute__((always_inline)) void wiener_put(__global real *filter, const wiener_run *g,
                                                             const int col, const int row, const int ny,
                                                             const int half_columns)
{
#if WIENER_BLOCK
    const size_t start = ((size_t)(col / WIENER_BLOCK) * ny + row) * 2 * WIENER_BLOCK + col % WIENER_BLOCK;
    for (int i = 0; i < WIENER_RUN; ++i) filter[start + i] = g->re[i];
    for (int i = 0; i < WIENER_RUN; ++i) filter[start + WIENER_BLOCK + i] = g->im[i];
#else
    const size_t start = 2 * ((size_t)row * half_columns + col);
    for (int i = 0; i < WIENER_RUN && col + i < half_columns; ++i) {
        filter[start + 2 * i] = g->re[i];
        filter[start + 2 * i + 1] = g->im[i];
    }
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
    const int col = WIENER_RUN * get_global_id(0), half_columns = nx / 2 + 1;
    const int held = clamp(half_columns - col, 0, WIENER_RUN);     // beyond them H = 0, and so G
    wiener_run u, g;
    real level[WIENER_RUN];
    for (int i = 0; i < WIENER_RUN; ++i) {
        const cplx h = i < held ? h_cols[(size_t)col_entry * nx + col + i] : (cplx)(0, 0);
        u.re[i] = h.x;
        u.im[i] = 2 * (col + i) == nx ? 0 : h.y;
    }
    for (int row = get_global_id(1); row < ny; row += get_global_size(1)) {
        const int frequency = order[row];
        cplx v = h_rows[(size_t)row_entry * ny + frequency];
        if (2 * frequency == ny) v.y = 0;
        for (int i = 0; i < WIENER_RUN; ++i) {
            g.re[i] = v.x * u.re[i] - v.y * u.im[i];
            g.im[i] = v.x * u.im[i] + v.y * u.re[i];
        }
        wiener_level(level, noise, nsr, (size_t)frequency * half_columns + col, held);
        wiener_gain(&g, level, scale);
        wiener_put(filter, &g, col, row, ny, half_columns);
    }
}

__kernel void wiener_spectrum(
    __global const cplx *restrict otf,
    __global const real *restrict noise,
    __global const int  *restrict order,
    __global real       *restrict filter,
    const int ny, const int nx,
    const real nsr, const real scale)
{
    const int col = WIENER_RUN * get_global_id(0), half_columns = nx / 2 + 1;
    const int held = clamp(half_columns - col, 0, WIENER_RUN);
    wiener_run g;
    real level[WIENER_RUN];
    for (int row = get_global_id(1); row < ny; row += get_global_size(1)) {
        const size_t start = (size_t)order[row] * half_columns + col;
        for (int i = 0; i < WIENER_RUN; ++i) {
            const cplx h = i < held ? otf[start + i] : (cplx)(0, 0);
            g.re[i] = h.x;
            g.im[i] = h.y;
        }
        wiener_level(level, noise, nsr, start, held);
        wiener_gain(&g, level, scale);
        wiener_put(filter, &g, col, row, ny, half_columns);
    }
}

__kernel void wiener_arrange(
    __global const cplx *restrict gain,
    __global const int  *restrict order,
    __global real       *restrict filter,
    const int ny, const int nx,
    const real scale)
{
    const int col = WIENER_RUN * get_global_id(0), half_columns = nx / 2 + 1;
    const int held = clamp(half_columns - col, 0, WIENER_RUN);
    wiener_run g;
    for (int row = get_global_id(1); row < ny; row += get_global_size(1)) {
        const size_t start = (size_t)order[row] * half_columns + col;
        for (int i = 0; i < WIENER_RUN; ++i) {
            const cplx value = i < held ? scale * gain[start + i] : (cplx)(0, 0);
            g.re[i] = value.x;
            g.im[i] = value.y;
        }
        wiener_put(filter, &g, col, row, ny, half_columns);
    }
}
