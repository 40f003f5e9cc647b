// restore_lanes.cl : undo a known blur of a frame, for processors with wide SIMD and few cores.
//
//   restored = IFFT2( FFT2( padded frame ) * filter )    docs/maths.md, eqs. W2 to W5
//
// Three kernels, no barriers: rows forward; columns forward, times filter, columns inverse; rows inverse. A
// work-item owns LANES * 2 rows or LANES columns, one to each SIMD lane. The transforms run in place,
// decimated in frequency going forward and in time coming back, so that nothing is ever reordered: rows and
// filter are addressed in digit-reversed order instead.
//
//   frame     (ROWS, COLS) IN_TYPE              the image to restore
//   image     (ROWS, COLS) OUT_TYPE             the restored image; integers are rounded and clamped
//   spectrum  (BLOCKS, HELD, 2, LANES) real     block of columns, row, real or imaginary, column in the block
//   filtered  like spectrum                     may be the spectrum itself
//   filter    (BLOCKS, NY, 2, LANES) real       the same, rows digit-reversed, scaled by 1 / (2 NX NY)
//   position  (2, BLOCKS * LANES) int           where frequency k, and then NX - k, lies after the passes
//   row_blend (NX - COLS) real, column_blend (NY - ROWS) real   share of the near edge in the padding
//   row_turns, column_turns   real              twiddle factors, pass by pass: cos and -sin, q = 1 .. R - 1
//
// A work-item's samples lie real, imaginary, real, .. : apart, the strides of a power of two would fill the
// same cache sets twice over.
//
// Defines: ROWS, COLS frame; NX, NY padded; HELD rows kept in the spectrum; BLOCKS column blocks; IN_TYPE,
// OUT_TYPE; OUT_LIMIT the largest code of an integer output, 0 for a real one. The passes come from the
// generated lists ROW_PASSES, ROW_PASSES_BACK, COLUMN_PASSES, COLUMN_PASSES_BACK, COLUMN_LAST.
//
// Local size 1; no local memory. Private memory: two vectors of 64 bytes for each sample of a row or column.
// Error: below 4e-7 (float) and 1e-15 (double), relative L2, 8 x 8 to 1024 x 1024, PoCL and Intel's runtime.

#define RESTORE_LANES 1

#include "restore_transpose.h"
#include "restore_butterflies.h"

#define RESTORE_JOIN_(A, B) A##B
#define RESTORE_JOIN(A, B)  RESTORE_JOIN_(A, B)

// Rows of a frame start anywhere: these promise no more than their element's alignment.
typedef RESTORE_JOIN(IN_TYPE, LANES)  in_vec  __attribute__((aligned(IN_BYTES)));
typedef RESTORE_JOIN(OUT_TYPE, LANES) out_vec __attribute__((aligned(OUT_BYTES)));

// OpenCL's convert_ functions are calls on some compilers, a vector conversion is one instruction.
#if defined(__has_builtin) && !RESTORE_PORTABLE
#if __has_builtin(__builtin_convertvector)
#define RESTORE_CONVERT(V, TYPE) __builtin_convertvector(V, RESTORE_JOIN(TYPE, LANES))
#endif
#endif
#ifndef RESTORE_CONVERT
#define RESTORE_CONVERT(V, TYPE) RESTORE_JOIN(RESTORE_JOIN(convert_, TYPE), LANES)(V)
#endif

// Without this, LLVM halves 64-byte vectors even where the registers hold them.
#ifdef __has_attribute
#if __has_attribute(min_vector_width)
#define RESTORE_WIDE __attribute__((min_vector_width(512)))
#endif
#endif
#ifndef RESTORE_WIDE
#define RESTORE_WIDE
#endif

// One pass forward over LENGTH values in runs of R * M: butterfly, then turn by exp(-2 pi i j q / (R M)).
// And one pass back: turn the other way, then the inverse butterfly.
#define RESTORE_DEFINE_PASSES(R)                                                                            \
    RESTORE_INLINE void restore_forward##R(vec *re, vec *im, const int length, const int m,                 \
                                           __global const real *turns)                                      \
    {                                                                                                       \
        for (int b = 0; b < length; b += R * m)                                                             \
            for (int j = 0; j < m; ++j) {                                                                   \
                vec xr[R], xi[R];                                                                           \
                _Pragma("unroll")                                                                           \
                for (int q = 0; q < R; ++q) {                                                               \
                    xr[q] = re[2 * (b + j + q * m)];                                                        \
                    xi[q] = im[2 * (b + j + q * m)];                                                        \
                }                                                                                           \
                restore_radix##R(xr, xi);                                                                   \
                re[2 * (b + j)] = xr[0];                                                                    \
                im[2 * (b + j)] = xi[0];                                                                    \
                _Pragma("unroll")                                                                           \
                for (int q = 1; q < R; ++q) {                                                               \
                    if (m == 1) {                                                                           \
                        re[2 * (b + j + q * m)] = xr[q];                                                    \
                        im[2 * (b + j + q * m)] = xi[q];                                                    \
                    } else {                                                                                \
                        const real c = turns[2 * (j * (R - 1) + q - 1)];                                    \
                        const real s = turns[2 * (j * (R - 1) + q - 1) + 1];                                \
                        re[2 * (b + j + q * m)] = xr[q] * c - xi[q] * s;                                    \
                        im[2 * (b + j + q * m)] = xr[q] * s + xi[q] * c;                                    \
                    }                                                                                       \
                }                                                                                           \
            }                                                                                               \
    }                                                                                                       \
    RESTORE_INLINE void restore_back##R(vec *re, vec *im, const int length, const int m,                    \
                                        __global const real *turns)                                         \
    {                                                                                                       \
        for (int b = 0; b < length; b += R * m)                                                             \
            for (int j = 0; j < m; ++j) {                                                                   \
                vec xr[R], xi[R];                                                                           \
                xr[0] = re[2 * (b + j)];                                                                    \
                xi[0] = im[2 * (b + j)];                                                                    \
                _Pragma("unroll")                                                                           \
                for (int q = 1; q < R; ++q) {                                                               \
                    const vec r = re[2 * (b + j + q * m)], i = im[2 * (b + j + q * m)];                     \
                    if (m == 1) {                                                                           \
                        xr[q] = r;                                                                          \
                        xi[q] = i;                                                                          \
                    } else {                                                                                \
                        const real c = turns[2 * (j * (R - 1) + q - 1)];                                    \
                        const real s = turns[2 * (j * (R - 1) + q - 1) + 1];                                \
                        xr[q] = r * c + i * s;                                                              \
                        xi[q] = i * c - r * s;                                                              \
                    }                                                                                       \
                }                                                                                           \
                restore_radix##R(xi, xr);                                                                   \
                _Pragma("unroll")                                                                           \
                for (int q = 0; q < R; ++q) {                                                               \
                    re[2 * (b + j + q * m)] = xr[q];                                                        \
                    im[2 * (b + j + q * m)] = xi[q];                                                        \
                }                                                                                           \
            }                                                                                               \
    }                                                                                                       \
    /* The last pass forward, the filter and the first pass back, without leaving the registers. */         \
    RESTORE_INLINE void restore_filter##R(vec *re, vec *im, const int length, __global const vec *filter)   \
    {                                                                                                       \
        for (int b = 0; b < length; b += R) {                                                               \
            vec xr[R], xi[R];                                                                               \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                xr[q] = re[2 * (b + q)];                                                                    \
                xi[q] = im[2 * (b + q)];                                                                    \
            }                                                                                               \
            restore_radix##R(xr, xi);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const vec fr = filter[2 * (b + q)], fi = filter[2 * (b + q) + 1], r = xr[q];                \
                xr[q] = r * fr - xi[q] * fi;                                                                \
                xi[q] = r * fi + xi[q] * fr;                                                                \
            }                                                                                               \
            restore_radix##R(xi, xr);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                re[2 * (b + q)] = xr[q];                                                                    \
                im[2 * (b + q)] = xi[q];                                                                    \
            }                                                                                               \
        }                                                                                                   \
    }

RESTORE_DEFINE_PASSES(2)
RESTORE_DEFINE_PASSES(3)
RESTORE_DEFINE_PASSES(4)
RESTORE_DEFINE_PASSES(5)
RESTORE_DEFINE_PASSES(6)
RESTORE_DEFINE_PASSES(7)
RESTORE_DEFINE_PASSES(8)
RESTORE_DEFINE_PASSES(9)
RESTORE_DEFINE_PASSES(10)
RESTORE_DEFINE_PASSES(12)
RESTORE_DEFINE_PASSES(15)

#define ROW_FORWARD(R, M, T)    restore_forward##R(re, im, NX, M, row_turns + T);
#define ROW_BACK(R, M, T)       restore_back##R(re, im, NX, M, row_turns + T);
#define COLUMN_FORWARD(R, M, T) restore_forward##R(re, im, NY, M, column_turns + T);
#define COLUMN_BACK(R, M, T)    restore_back##R(re, im, NY, M, column_turns + T);
#define COLUMN_FILTER(R)        restore_filter##R(re, im, NY, block_filter);

// LANES columns from `col` on of the rows `row` to `row + LANES - 1`, one row to a lane; 0 below the frame,
// since whatever stood there would leak its rounding errors into the row it shares a transform with.
RESTORE_INLINE void restore_load_square(vec *v, __global const IN_TYPE *frame, const int row, const int col)
{
    vec square[LANES];
    _Pragma("unroll")
    for (int i = 0; i < LANES; ++i)
        square[i] = row + i < ROWS
            ? RESTORE_CONVERT(*(__global const in_vec *)(frame + (size_t)(row + i) * COLS + col), SCALAR)
            : (vec)(0);
    restore_transpose(square);
    _Pragma("unroll")
    for (int i = 0; i < LANES; ++i) v[2 * i] = square[i];
}

RESTORE_INLINE void restore_load(vec *v, __global const IN_TYPE *frame, const int row)
{
#if COLS >= LANES
    for (int col = 0; col + LANES <= COLS; col += LANES) restore_load_square(v + 2 * col, frame, row, col);
    if (COLS % LANES) restore_load_square(v + 2 * (COLS - LANES), frame, row, COLS - LANES);
#else
    for (int col = 0; col < COLS; ++col)
        for (int i = 0; i < LANES; ++i)
            ((real *)&v[2 * col])[i] = row + i < ROWS ? (real)frame[(row + i) * COLS + col] : (real)0;
#endif
}

#if OUT_LIMIT
RESTORE_INLINE vec restore_round(const vec v)
{
    const vec low = v > (vec)(0) ? v : (vec)(0);
    return (low < (vec)(OUT_LIMIT) ? low : (vec)(OUT_LIMIT)) + REAL_C(0.5);    // the conversion truncates
}
#else
#define restore_round(V) (V)
#endif

RESTORE_INLINE void restore_store_square(const vec *lines, __global OUT_TYPE *image, const int row,
                                         const int col)
{
    vec v[LANES];
    _Pragma("unroll")
    for (int i = 0; i < LANES; ++i) v[i] = lines[2 * i];
    restore_transpose(v);
    _Pragma("unroll")
    for (int i = 0; i < LANES; ++i)
        if (row + i < ROWS)
            *(__global out_vec *)(image + (size_t)(row + i) * COLS + col) =
                RESTORE_CONVERT(restore_round(v[i]), OUT_TYPE);
}

RESTORE_INLINE void restore_store(const vec *v, __global OUT_TYPE *image, const int row)
{
#if COLS >= LANES
    for (int col = 0; col + LANES <= COLS; col += LANES) restore_store_square(v + 2 * col, image, row, col);
    if (COLS % LANES) restore_store_square(v + 2 * (COLS - LANES), image, row, COLS - LANES);
#else
    for (int col = 0; col < COLS; ++col) {
        const vec rounded = restore_round(v[2 * col]);
        for (int i = 0; i < LANES; ++i)
            if (row + i < ROWS) image[(row + i) * COLS + col] = (OUT_TYPE)((const real *)&rounded)[i];
    }
#endif
}

// Work-item b transforms rows 2 b LANES onward: the first LANES as real parts, the next as imaginary parts.
__kernel RESTORE_WIDE void __attribute__((reqd_work_group_size(1, 1, 1)))
restore_rows_forward(
    __global const IN_TYPE *restrict frame,
    __global vec           *restrict spectrum,
    __global const int     *restrict position,
    __global const real    *restrict row_turns,
    __global const real    *restrict row_blend)
{
    vec work[2 * NX], *re = work, *im = work + 1, v[LANES];
    const int row = 2 * LANES * get_global_id(0);
    restore_load(re, frame, row);
    restore_load(im, frame, row + LANES);
    for (int i = COLS; i < NX; ++i) {
        const real w = row_blend[i - COLS];
        re[2 * i] = re[2 * (COLS - 1)] + w * (re[0] - re[2 * (COLS - 1)]);
        im[2 * i] = im[2 * (COLS - 1)] + w * (im[0] - im[2 * (COLS - 1)]);
    }
    ROW_PASSES(ROW_FORWARD)
    // Two real rows in one complex transform come apart by symmetry; the factor 1/2 is in the filter.
    for (int block = 0; block < BLOCKS; ++block) {
        __global vec *out = spectrum + 2 * ((size_t)block * HELD + row);
        __global const int *here = position + block * LANES, *mirror = here + BLOCKS * LANES;
        for (int i = 0; i < LANES; ++i) v[i] = re[2 * here[i]] + re[2 * mirror[i]];
        restore_transpose(v);
        for (int i = 0; i < LANES; ++i) out[2 * i] = v[i];
        for (int i = 0; i < LANES; ++i) v[i] = im[2 * here[i]] - im[2 * mirror[i]];
        restore_transpose(v);
        for (int i = 0; i < LANES; ++i) out[2 * i + 1] = v[i];
        out += 2 * LANES;
        for (int i = 0; i < LANES; ++i) v[i] = im[2 * here[i]] + im[2 * mirror[i]];
        restore_transpose(v);
        for (int i = 0; i < LANES; ++i) out[2 * i] = v[i];
        for (int i = 0; i < LANES; ++i) v[i] = re[2 * mirror[i]] - re[2 * here[i]];
        restore_transpose(v);
        for (int i = 0; i < LANES; ++i) out[2 * i + 1] = v[i];
    }
}

// Work-item b carries column block b there and back; the rows of the padding are made here, from two others.
__kernel RESTORE_WIDE void __attribute__((reqd_work_group_size(1, 1, 1)))
restore_columns(
    __global const vec  *spectrum,
    __global vec        *filtered,
    __global const vec  *restrict filter,
    __global const real *restrict column_turns,
    __global const real *restrict column_blend)
{
    vec work[2 * NY], *re = work, *im = work + 1;
    const size_t block = get_global_id(0);
    __global const vec *source = spectrum + 2 * block * HELD;
    __global const vec *block_filter = filter + 2 * block * NY;
    for (int y = 0; y < ROWS; ++y) {
        re[2 * y] = source[2 * y];
        im[2 * y] = source[2 * y + 1];
    }
    for (int y = ROWS; y < NY; ++y) {
        const real w = column_blend[y - ROWS];
        re[2 * y] = re[2 * (ROWS - 1)] + w * (re[0] - re[2 * (ROWS - 1)]);
        im[2 * y] = im[2 * (ROWS - 1)] + w * (im[0] - im[2 * (ROWS - 1)]);
    }
    COLUMN_PASSES(COLUMN_FORWARD)
    COLUMN_LAST(COLUMN_FILTER)
    COLUMN_PASSES_BACK(COLUMN_BACK)
    __global vec *out = filtered + 2 * block * HELD;
    for (int y = 0; y < ROWS; ++y) {
        out[2 * y] = re[2 * y];
        out[2 * y + 1] = im[2 * y];
    }
    for (int y = 2 * ROWS; y < 2 * HELD; ++y) out[y] = (vec)(0);
}

// Work-item b puts rows 2 b LANES onward together again: the same pairs, the same order, backwards.
__kernel RESTORE_WIDE void __attribute__((reqd_work_group_size(1, 1, 1)))
restore_rows_inverse(
    __global const vec  *restrict filtered,
    __global OUT_TYPE   *restrict image,
    __global const int  *restrict position,
    __global const real *restrict row_turns)
{
    vec work[2 * NX], *re = work, *im = work + 1, ar[LANES], ai[LANES], br[LANES], bi[LANES];
    const int row = 2 * LANES * get_global_id(0);
    for (int block = 0; block < BLOCKS; ++block) {
        __global const vec *in = filtered + 2 * ((size_t)block * HELD + row);
        for (int i = 0; i < LANES; ++i) {
            ar[i] = in[2 * i];
            ai[i] = in[2 * i + 1];
            br[i] = in[2 * (LANES + i)];
            bi[i] = in[2 * (LANES + i) + 1];
        }
        restore_transpose(ar);
        restore_transpose(ai);
        restore_transpose(br);
        restore_transpose(bi);
        __global const int *here = position + block * LANES, *mirror = here + BLOCKS * LANES;
        for (int i = 0; i < LANES && block * LANES + i <= NX / 2; ++i) {
            const int p = here[i], q = mirror[i];
            re[2 * p] = p == q ? ar[i] : ar[i] - bi[i];     // a bin that mirrors itself is real
            im[2 * p] = p == q ? br[i] : ai[i] + br[i];
            if (p != q) {
                re[2 * q] = ar[i] + bi[i];
                im[2 * q] = br[i] - ai[i];
            }
        }
    }
    ROW_PASSES_BACK(ROW_BACK)
    restore_store(re, image, row);
    restore_store(im, image, row + LANES);
}
