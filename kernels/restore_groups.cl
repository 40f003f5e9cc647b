// restore_groups.cl : undo a known blur of a frame, for processors with many small cores.
//
//   restored = IFFT2( FFT2( padded frame ) * filter )    docs/maths.md, eqs. W2 to W5
//   filter   = conj(H) / (|H|^2 + nsr), H = h_row h_column, where it is not stored            eqs. W1 and W9
//
// Three kernels: rows forward; columns forward, times filter, columns inverse; rows inverse. A work-group owns
// two rows (one complex transform) or a block of BLOCK columns. The transforms run in place, decimated in
// frequency going forward and in time coming back, so that nothing is ever reordered.
//
//   frame     (ROWS, COLS) IN_TYPE              the image to restore
//   image     (ROWS, COLS) OUT_TYPE             the restored image; integers are rounded and clamped
//   spectrum  (BLOCKS, HELD, 2, BLOCK) stored   block of horizontal frequencies, row, real or imaginary, frequency in
//                                               the block; half where HALF_SPECTRUM, else real
//   filtered  like spectrum                     may be the spectrum itself
//   filter    (BLOCKS, NY, 2, BLOCK) real       the same, vertical frequencies digit-reversed, times the scale below.
//                                               Or null:
//   otf       (.., 2) real                      1-D OTFs, DC first, from number `otf_from` on; real where Nyquist is
//   bin       (NY + BLOCKS * BLOCK) int         where the H of a place is among them: along y, then along x
//   position  (2, BLOCKS * BLOCK) int           where a column's frequency k, and NX - k, lie after the passes
//   noise, scale              real              nsr and what the transforms leave undone, lifted (W9)
//   row_blend (NX - COLS) real, column_blend (NY - ROWS) real   share of the near edge in the padding
//   row_turns, column_turns   real              twiddle factors, pass by pass: cos and -sin, q = 1 .. R - 1
//   scratch   (work-groups, 2, samples) real    used where local memory is too small, else null
//
// Defines as in restore_lanes.cl, and: BLOCK columns per block; ROW_ITEMS, COLUMN_ITEMS work-items per group,
// COLUMN_ITEMS a multiple of BLOCK; BLOCKS of columns, HELD rows of the spectrum; ROW_LOCAL, COLUMN_LOCAL 1: the
// samples stand in local memory, 0: in `scratch`, for axes longer than local memory allows.
//
// Local memory: 2 NX reals for rows, 2 NY BLOCK reals for columns. One barrier after each pass.
// Error: below 4e-7 (float) and 1e-15 (double), relative L2, 8 x 8 to 1024 x 1024, PoCL and Intel's runtime.

#include "restore_butterflies.h"
#include "wiener_lift.h"

#if ROW_LOCAL
#define ROW_SPACE   __local
#define ROW_WORK(N) __local real work[2 * (N)]
#define ROW_FENCE   CLK_LOCAL_MEM_FENCE
#else
#define ROW_SPACE   __global
#define ROW_WORK(N) __global real *work = scratch + (size_t)get_group_id(0) * 2 * (N)
#define ROW_FENCE   CLK_GLOBAL_MEM_FENCE
#endif

#if COLUMN_LOCAL
#define COLUMN_SPACE   __local
#define COLUMN_WORK(N) __local real work[2 * (N)]
#define COLUMN_FENCE   CLK_LOCAL_MEM_FENCE
#else
#define COLUMN_SPACE   __global
#define COLUMN_WORK(N) __global real *work = scratch + (size_t)get_group_id(0) * 2 * (N)
#define COLUMN_FENCE   CLK_GLOBAL_MEM_FENCE
#endif

#if HALF_SPECTRUM
typedef half stored;
#define GET(P, I)    vload_half(I, P)
#define PUT(P, I, V) vstore_half(V, I, P)
#define SCALED(V)    ((V) * (REAL_C(0.5) / (NX * STORED_LEVEL)))
#else
typedef real stored;
#define GET(P, I)    (P)[I]
#define PUT(P, I, V) (P)[I] = V
#define SCALED(V)    (V)
#endif

// One pass over `length` samples, `width` of them interleaved, shared by `workers` work-items of each `lane`.
#define RESTORE_DEFINE_PASSES(R, AXIS)                                                                      \
    ALWAYS_INLINE void restore_forward##AXIS##R(AXIS##_SPACE real *re, AXIS##_SPACE real *im,              \
                                                 const int length, const int m, const int width,            \
                                                 const int lane, const int worker, const int workers,       \
                                                 __global const real *turns)                                \
    {                                                                                                       \
        for (int i = worker; i < length / R; i += workers) {                                                \
            const int j = i % m, first = (i / m * R * m + j) * width + lane, step = m * width;              \
            vec xr[R], xi[R];                                                                               \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                xr[q] = re[first + q * step];                                                               \
                xi[q] = im[first + q * step];                                                               \
            }                                                                                               \
            restore_radix##R(xr, xi);                                                                       \
            re[first] = xr[0];                                                                              \
            im[first] = xi[0];                                                                              \
            _Pragma("unroll")                                                                               \
            for (int q = 1; q < R; ++q) {                                                                   \
                const real c = turns[2 * (j * (R - 1) + q - 1)];                                            \
                const real s = turns[2 * (j * (R - 1) + q - 1) + 1];                                        \
                re[first + q * step] = xr[q] * c - xi[q] * s;                                               \
                im[first + q * step] = xr[q] * s + xi[q] * c;                                               \
            }                                                                                               \
        }                                                                                                   \
        barrier(AXIS##_FENCE);                                                                              \
    }                                                                                                       \
    ALWAYS_INLINE void restore_back##AXIS##R(AXIS##_SPACE real *re, AXIS##_SPACE real *im,                 \
                                              const int length, const int m, const int width,               \
                                              const int lane, const int worker, const int workers,          \
                                              __global const real *turns)                                   \
    {                                                                                                       \
        for (int i = worker; i < length / R; i += workers) {                                                \
            const int j = i % m, first = (i / m * R * m + j) * width + lane, step = m * width;              \
            vec xr[R], xi[R];                                                                               \
            xr[0] = re[first];                                                                              \
            xi[0] = im[first];                                                                              \
            _Pragma("unroll")                                                                               \
            for (int q = 1; q < R; ++q) {                                                                   \
                const real c = turns[2 * (j * (R - 1) + q - 1)];                                            \
                const real s = turns[2 * (j * (R - 1) + q - 1) + 1];                                        \
                const vec a = re[first + q * step], b = im[first + q * step];                               \
                xr[q] = a * c + b * s;                                                                      \
                xi[q] = b * c - a * s;                                                                      \
            }                                                                                               \
            restore_radix##R(xi, xr);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                re[first + q * step] = xr[q];                                                               \
                im[first + q * step] = xi[q];                                                               \
            }                                                                                               \
        }                                                                                                   \
        barrier(AXIS##_FENCE);                                                                              \
    }

// The last pass forward, the filter and the first pass back, without leaving the registers.
#define RESTORE_DEFINE_FILTER(R)                                                                            \
    ALWAYS_INLINE void restore_filter##R(COLUMN_SPACE real *re, COLUMN_SPACE real *im, const int lane,     \
                                          const int worker, const int workers,                              \
                                          __global const real *filter)                                      \
    {                                                                                                       \
        for (int i = worker; i < NY / R; i += workers) {                                                    \
            vec xr[R], xi[R];                                                                               \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                xr[q] = re[(i * R + q) * BLOCK + lane];                                                     \
                xi[q] = im[(i * R + q) * BLOCK + lane];                                                     \
            }                                                                                               \
            restore_radix##R(xr, xi);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const real fr = filter[(i * R + q) * 2 * BLOCK + lane];                                     \
                const real fi = filter[((i * R + q) * 2 + 1) * BLOCK + lane];                               \
                const vec a = xr[q];                                                                        \
                xr[q] = a * fr - xi[q] * fi;                                                                \
                xi[q] = a * fi + xi[q] * fr;                                                                \
            }                                                                                               \
            restore_radix##R(xi, xr);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                re[(i * R + q) * BLOCK + lane] = xr[q];                                                     \
                im[(i * R + q) * BLOCK + lane] = xi[q];                                                     \
            }                                                                                               \
        }                                                                                                   \
        barrier(COLUMN_FENCE);                                                                              \
    }

// The same with the filter formed here, from H of the rows (the same for all lanes) and of the lane's column.
#define RESTORE_DEFINE_WIENER(R)                                                                            \
    ALWAYS_INLINE void restore_wiener##R(COLUMN_SPACE real *re, COLUMN_SPACE real *im, const int lane,      \
                                         const int worker, const int workers,                               \
                                         __global const real *otf, __global const int *bin, const cplx h,   \
                                         const real noise, const real scale)                                \
    {                                                                                                       \
        for (int i = worker; i < NY / R; i += workers) {                                                    \
            vec xr[R], xi[R];                                                                               \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                xr[q] = re[(i * R + q) * BLOCK + lane];                                                     \
                xi[q] = im[(i * R + q) * BLOCK + lane];                                                     \
            }                                                                                               \
            restore_radix##R(xr, xi);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const real gr = WIENER_LIFT * otf[2 * bin[i * R + q]];                                      \
                const real gi = WIENER_LIFT * otf[2 * bin[i * R + q] + 1];                                  \
                const real power = (gr * gr + gi * gi) * (h.x * h.x + h.y * h.y) + noise;                   \
                const real share = power > REAL_LEAST ? scale / power : 0;                                  \
                const real tr = xr[q] * gr + xi[q] * gi, ti = xi[q] * gr - xr[q] * gi;                      \
                xr[q] = (tr * h.x + ti * h.y) * share;                                                      \
                xi[q] = (ti * h.x - tr * h.y) * share;                                                      \
            }                                                                                               \
            restore_radix##R(xi, xr);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                re[(i * R + q) * BLOCK + lane] = xr[q];                                                     \
                im[(i * R + q) * BLOCK + lane] = xi[q];                                                     \
            }                                                                                               \
        }                                                                                                   \
        barrier(COLUMN_FENCE);                                                                              \
    }

#define RESTORE_DEFINE(R)               \
    RESTORE_DEFINE_PASSES(R, ROW)       \
    RESTORE_DEFINE_PASSES(R, COLUMN)    \
    RESTORE_DEFINE_FILTER(R)            \
    RESTORE_DEFINE_WIENER(R)

RESTORE_DEFINE(2)
RESTORE_DEFINE(3)
RESTORE_DEFINE(4)
RESTORE_DEFINE(5)
RESTORE_DEFINE(6)
RESTORE_DEFINE(7)
RESTORE_DEFINE(8)
RESTORE_DEFINE(9)
RESTORE_DEFINE(10)
RESTORE_DEFINE(12)
RESTORE_DEFINE(15)

#define ROW_FORWARD(R, M, T) restore_forwardROW##R(re, im, NX, M, 1, 0, item, ROW_ITEMS, row_turns + T);
#define ROW_BACK(R, M, T)    restore_backROW##R(re, im, NX, M, 1, 0, item, ROW_ITEMS, row_turns + T);
#define COLUMN_FORWARD(R, M, T) \
    restore_forwardCOLUMN##R(re, im, NY, M, BLOCK, lane, worker, COLUMN_ITEMS / BLOCK, column_turns + T);
#define COLUMN_BACK(R, M, T) \
    restore_backCOLUMN##R(re, im, NY, M, BLOCK, lane, worker, COLUMN_ITEMS / BLOCK, column_turns + T);
#define COLUMN_FILTER(R, M, T) restore_filter##R(re, im, lane, worker, COLUMN_ITEMS / BLOCK, block_filter);
#define COLUMN_WIENER(R, M, T) \
    restore_wiener##R(re, im, lane, worker, COLUMN_ITEMS / BLOCK, axes, bin, h, noise, scale);

// A sample of a frame's row, padded; 0 below the frame.
ALWAYS_INLINE real restore_sample(__global const IN_TYPE *frame, const int row, const int col,
                                   __global const real *row_blend)
{
    if (row >= ROWS) return 0;
    __global const IN_TYPE *line = frame + (size_t)row * COLS;
    if (col < COLS) return (real)line[col];
    const real far = (real)line[COLS - 1], near = (real)line[0];
    return far + row_blend[col - COLS] * (near - far);
}

ALWAYS_INLINE void restore_put(__global OUT_TYPE *image, const int row, const int col, const real value)
{
    if (row >= ROWS) return;
    const real level = value * STORED_LEVEL;
#if OUT_LIMIT
    const real low = level > 0 ? level : 0;
    image[(size_t)row * COLS + col] = (OUT_TYPE)((low < OUT_LIMIT ? low : OUT_LIMIT) + REAL_C(0.5));
#else
    image[(size_t)row * COLS + col] = level;
#endif
}

// Work-group g transforms rows 2 g and 2 g + 1 as the real and imaginary parts of one.
__kernel void __attribute__((reqd_work_group_size(ROW_ITEMS, 1, 1)))
restore_rows_forward(
    __global const IN_TYPE *restrict frame,
    __global stored        *restrict spectrum,
    __global const int     *restrict position,
    __global const real    *restrict row_turns,
    __global const real    *restrict row_blend,
    __global real          *restrict scratch)
{
    ROW_WORK(NX);
    ROW_SPACE real *re = work, *im = work + NX;
    const int item = get_local_id(0), row = 2 * get_group_id(0);
    for (int col = item; col < NX; col += ROW_ITEMS) {
        re[col] = restore_sample(frame, row, col, row_blend);
        im[col] = restore_sample(frame, row + 1, col, row_blend);
    }
    barrier(ROW_FENCE);
    ROW_FIRST(ROW_FORWARD)
    ROW_MIDDLE(ROW_FORWARD)
    ROW_LAST(ROW_FORWARD)
    // Two real rows in one complex transform come apart by symmetry; the factor 1/2 is in the filter.
    for (int k = item; k < BLOCKS * BLOCK; k += ROW_ITEMS) {
        const int p = position[k], q = position[BLOCKS * BLOCK + k];
        const size_t start = ((size_t)(k / BLOCK) * HELD + row) * 2 * BLOCK + k % BLOCK;
        PUT(spectrum, start, SCALED(re[p] + re[q]));
        PUT(spectrum, start + BLOCK, SCALED(im[p] - im[q]));
        PUT(spectrum, start + 2 * BLOCK, SCALED(im[p] + im[q]));
        PUT(spectrum, start + 3 * BLOCK, SCALED(re[q] - re[p]));
    }
}

// Work-group g carries column block g there and back; the rows of the padding are made here, from two others.
__kernel void __attribute__((reqd_work_group_size(COLUMN_ITEMS, 1, 1)))
restore_columns(
    __global const stored *spectrum,
    __global stored       *filtered,
    __global const real *restrict filter,
    __global const real *restrict otf,
    __global const int  *restrict bin,
    __global const real *restrict column_turns,
    __global const real *restrict column_blend,
    __global real       *restrict scratch,
    const int otf_from,
    const real noise, const real scale)
{
    COLUMN_WORK(NY * BLOCK);
    COLUMN_SPACE real *re = work, *im = work + NY * BLOCK;
    const int lane = get_local_id(0) % BLOCK, worker = get_local_id(0) / BLOCK;
    const size_t block = get_group_id(0);
    __global const stored *source = spectrum + block * HELD * 2 * BLOCK + lane;
    __global const real *block_filter = filter + block * NY * 2 * BLOCK;
    for (int y = worker; y < NY; y += COLUMN_ITEMS / BLOCK) {
        real r, i;
        if (y < ROWS) {
            r = GET(source, y * 2 * BLOCK);
            i = GET(source, (y * 2 + 1) * BLOCK);
        } else {
            const real w = column_blend[y - ROWS];
            const real far_r = GET(source, (ROWS - 1) * 2 * BLOCK), far_i = GET(source, ((ROWS - 1) * 2 + 1) * BLOCK);
            r = far_r + w * (GET(source, 0) - far_r);
            i = far_i + w * (GET(source, BLOCK) - far_i);
        }
        re[y * BLOCK + lane] = r;
        im[y * BLOCK + lane] = i;
    }
    barrier(COLUMN_FENCE);
    COLUMN_FIRST(COLUMN_FORWARD)
    COLUMN_MIDDLE(COLUMN_FORWARD)
    if (filter) {
        COLUMN_LAST(COLUMN_FILTER)
    } else {
        __global const real *axes = otf + 2 * otf_from;
        const int at = 2 * bin[NY + block * BLOCK + lane];
        const cplx h = WIENER_LIFT * (cplx)(axes[at], axes[at + 1]);
        COLUMN_LAST(COLUMN_WIENER)
    }
    COLUMN_MIDDLE_BACK(COLUMN_BACK)
    COLUMN_FIRST(COLUMN_BACK)
    __global stored *out = filtered + block * HELD * 2 * BLOCK + lane;
    for (int y = worker; y < HELD; y += COLUMN_ITEMS / BLOCK) {
        PUT(out, y * 2 * BLOCK, y < ROWS ? re[y * BLOCK + lane] : (real)0);
        PUT(out, (y * 2 + 1) * BLOCK, y < ROWS ? im[y * BLOCK + lane] : (real)0);
    }
}

// Work-group g puts rows 2 g and 2 g + 1 together again.
__kernel void __attribute__((reqd_work_group_size(ROW_ITEMS, 1, 1)))
restore_rows_inverse(
    __global const stored *restrict filtered,
    __global OUT_TYPE   *restrict image,
    __global const int  *restrict position,
    __global const real *restrict row_turns,
    __global real       *restrict scratch)
{
    ROW_WORK(NX);
    ROW_SPACE real *re = work, *im = work + NX;
    const int item = get_local_id(0), row = 2 * get_group_id(0);
    for (int k = item; k <= NX / 2; k += ROW_ITEMS) {
        const int p = position[k], q = position[BLOCKS * BLOCK + k];
        const size_t start = ((size_t)(k / BLOCK) * HELD + row) * 2 * BLOCK + k % BLOCK;
        const real ar = GET(filtered, start), ai = GET(filtered, start + BLOCK);
        const real br = GET(filtered, start + 2 * BLOCK), bi = GET(filtered, start + 3 * BLOCK);
        re[p] = p == q ? ar : ar - bi;      // a bin that mirrors itself is real
        im[p] = p == q ? br : ai + br;
        if (p != q) {
            re[q] = ar + bi;
            im[q] = br - ai;
        }
    }
    barrier(ROW_FENCE);
    ROW_LAST(ROW_BACK)
    ROW_MIDDLE_BACK(ROW_BACK)
    ROW_FIRST(ROW_BACK)
    for (int col = item; col < COLS; col += ROW_ITEMS) {
        restore_put(image, row, col, re[col]);
        restore_put(image, row + 1, col, im[col]);
    }
}
