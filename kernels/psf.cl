// psf.cl : point-spread and transfer function of a stop that does not separate, by two-dimensional transforms.
//
//   psf = |IFFT2 P|^2 / sum,  otf = FFT2 psf                                    docs/maths.md, eq. O11
//
// psf_panel: what a pixelated modulator shows. One work-item per pupil cell; no local memory, no barriers.
//   codes      (panel rows, panel columns) uchar
//   smooth     (n, n) real    turns added to the panel's: the object's defocus
//   row_of, column_of (n) int panel pixel under each cell
//   turns      (n, n) real    result, in [0, 1)
//   n, panel_columns
//   turns_per_code real
//
// psf_field: the pupil, zero-padded. One work-item per cell of the result; no local memory, no barriers.
//   turns      (n, n) real    phase
//   amplitude  (n, n) real    stop; 0 outside
//   field      (m, m) cplx    result
//   n, m
//
// psf_fft: one pass along one axis. One work-item per butterfly; no local memory, no barriers.
//   x, roots   (m, m) cplx, (m/2) cplx    see stockham.h
//   y          (m, m) cplx    result
//   m, s, along_rows, sign    along_rows: the transform runs within each row
//
// psf_intensity: |field|^2 scaled. One work-item per sample; no local memory, no barriers.
//   field      (m, m) cplx    overwritten with the result as complex numbers
//   psf        (m, m) real    result
//   m
//   scale      real           1/(m^2 sum amplitude^2): the psf sums to 1
//
// Error: relative L2 of the psf below 5e-7 in float, 2e-15 in double, at m = 1024 (PoCL, Intel).

// phase_turns.h first: it forbids contraction, so that psf_intensity's imaginary parts cancel.
#include "phase_turns.h"
#include "stockham.h"

__kernel void psf_panel(
    __global const uchar *codes,
    __global const real  *smooth,
    __global const int   *row_of,
    __global const int   *column_of,
    __global real        *turns,
    const int n, const int panel_columns,
    const real turns_per_code)
{
    const int column = get_global_id(0);
    const int row = get_global_id(1);
    if (row >= n || column >= n) return;
    const int i = row * n + column;
    turns[i] = turns_wrap(smooth[i] + turns_per_code * codes[row_of[row] * panel_columns + column_of[column]]);
}

__kernel void psf_field(
    __global const real *turns,
    __global const real *amplitude,
    __global cplx       *field,
    const int n, const int m)
{
    const int column = get_global_id(0);
    const int row = get_global_id(1);
    if (row >= m || column >= m) return;
    cplx value = (cplx)(0);
    if (row < n && column < n) {
        const int i = row * n + column;
        value = amplitude[i] * turns_cis(turns[i]);
    }
    field[row * m + column] = value;
}

__kernel void psf_fft(
    __global const cplx *x,
    __global const cplx *roots,
    __global cplx       *y,
    const int m, const int s, const int along_rows, const int sign)
{
    const int column = get_global_id(0);
    const int row = get_global_id(1);
    const int j = along_rows ? column : row;        // butterfly
    const int line = along_rows ? row : column;
    if (j >= m / 2 || line >= m) return;
    stockham_pass(x, y, roots, along_rows ? line * m : line, along_rows ? 1 : m, m, s, j, sign);
}

__kernel void psf_intensity(
    __global cplx *field,
    __global real *psf,
    const int m,
    const real scale)
{
    const int column = get_global_id(0);
    const int row = get_global_id(1);
    if (row >= m || column >= m) return;
    const int i = row * m + column;
    const cplx f = field[i];
    const cplx value = scale * cplx_mul(f, cplx_conj(f));   // the imaginary parts cancel to the last bit
    psf[i] = value.x;
    field[i] = value;
}
