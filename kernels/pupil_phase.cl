// pupil_phase.cl : the phase over the stop, as the fraction of a turn that the field depends on.
//
//   phi = sum over x, y of [tilt t + psi t^2 + alpha t^3 + odd(t)] + map       docs/maths.md, eqs. P1 and P2
//
// pupil_phase_axis: one axis' terms. One work-item per sample; no local memory, no barriers.
//   t          (n, 2) real    coordinate in half apertures, hi and lo
//   odd        (n) real       further profile, turns, wrapped; read only where has_odd
//   axis_turns (n) real       result, turns, in [-1, 1]
//   n, has_odd
//   tilt_*, psi_*, alpha_*    real, turns at t = 1, hi and lo
//
// pupil_phase: the plane. One work-item per sample; no local memory, no barriers.
//   x_turns    (columns) real, y_turns (rows) real     from pupil_phase_axis
//   map        (rows, columns) real   turns, wrapped; read only where has_map
//   turns      (rows, columns) real   result, in [0, 1)
//   rows, columns, has_map
//
// Error: modulo a turn, up to alpha = 1e5 (PoCL, Intel), below 4e-7 rad in float, 2e-6 with profiles and a map;
// 1e-16 alpha rad in double (the double reference's own rounding).

#include "phase_turns.h"

__kernel void pupil_phase_axis(
    __global const real2 *t,
    __global const real  *odd,
    __global real        *axis_turns,
    const int n, const int has_odd,
    const real tilt_hi, const real tilt_lo,
    const real psi_hi, const real psi_lo,
    const real alpha_hi, const real alpha_lo)
{
    const int i = get_global_id(0);
    if (i >= n) return;
    const real f = phase_turns(t[i], (two_term)(tilt_hi, tilt_lo), (two_term)(psi_hi, psi_lo),
                               (two_term)(alpha_hi, alpha_lo));
    axis_turns[i] = has_odd ? f + odd[i] : f;
}

__kernel void pupil_phase(
    __global const real *x_turns,
    __global const real *y_turns,
    __global const real *map,
    __global real       *turns,
    const int rows, const int columns, const int has_map)
{
    const int column = get_global_id(0);
    const int row = get_global_id(1);
    if (row >= rows || column >= columns) return;
    const int i = row * columns + column;
    const real f = x_turns[column] + y_turns[row];
    turns[i] = turns_wrap(has_map ? f + map[i] : f);
}
