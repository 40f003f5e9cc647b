// slm_encode.cl : the mask as the modulator's 8-bit codes.
//
//   level = floor(256 f + 1/2) mod 256,  code = table[level] inside the stop, 0 outside    docs/maths.md, eq. E2
//
// slm_encode_axis: one axis' phase at the panel's pixels. One work-item per pixel; no local memory, no barriers.
//   t          (n, 2) real    coordinate in half apertures (eq. E1), hi and lo
//   axis_turns (n) real       result, turns, in [-1/2, 1/2]
//   n
//   tilt_*, psi_*, alpha_*    real, turns at t = 1, hi and lo
//
// slm_encode: the panel. One work-item per pixel; no local memory, no barriers.
//   x_turns    (columns) real, y_turns (rows) real     from slm_encode_axis
//   correction (rows, columns) real   turns, wrapped; read only where has_correction
//   table      (256) uchar            level to code
//   codes      (rows, columns) uchar  result
//   rows, columns, has_correction
//   first_row, last_row, first_column, last_column     the pixels the stop uncovers, inclusive
//
// Error: none but one level where 256 f + 1/2 is within 1e-4 of a whole number.

#include "phase_turns.h"

__kernel void slm_encode_axis(
    __global const real2 *t,
    __global real        *axis_turns,
    const int n,
    const real tilt_hi, const real tilt_lo,
    const real psi_hi, const real psi_lo,
    const real alpha_hi, const real alpha_lo)
{
    const int i = get_global_id(0);
    if (i >= n) return;
    axis_turns[i] = phase_turns(t[i], (two_term)(tilt_hi, tilt_lo), (two_term)(psi_hi, psi_lo),
                                (two_term)(alpha_hi, alpha_lo));
}

__kernel void slm_encode(
    __global const real  *x_turns,
    __global const real  *y_turns,
    __global const real  *correction,
    __global const uchar *table,
    __global uchar       *codes,
    const int rows, const int columns, const int has_correction,
    const int first_row, const int last_row, const int first_column, const int last_column)
{
    const int column = get_global_id(0);
    const int row = get_global_id(1);
    if (row >= rows || column >= columns) return;
    const int i = row * columns + column;
    if (row < first_row || row > last_row || column < first_column || column > last_column) {
        codes[i] = 0;
        return;
    }
    real f = x_turns[column] + y_turns[row];
    if (has_correction) f += correction[i];
    codes[i] = table[(int)(256 * turns_wrap(f) + REAL_C(0.5)) & 255];
}
