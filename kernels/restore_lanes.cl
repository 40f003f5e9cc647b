// restore_lanes.cl : undo a known blur of a frame, for processors with wide SIMD and few cores.
//
//   restored = IFFT2( FFT2( padded frame ) * filter )    docs/maths.md, eqs. W2 to W5
//   filter   = conj(H) / (|H|^2 + nsr), H = h_row h_column, where it is not stored            eqs. W1 and W9
//
// Three steps: columns forward; rows forward, times filter, rows inverse; columns inverse. A task is LANES * 2
// columns or the spectra of LANES rows, one to each SIMD lane: pixels are read and written as they lie, and only
// the spectra change their lanes, once there and once back. The transforms run decimated in frequency going forward
// and in time coming back, so that nothing is ever reordered: spectrum and filter are addressed in digit-reversed
// order instead. What lies between the first pass forward and the last one back runs to its end on one part of the
// first pass before the next part is touched, in the cache nearest to the core.
//
//   frame     (ROWS, COLS) IN_TYPE              the image to restore
//   image     (ROWS, COLS) OUT_TYPE             the restored image; integers are rounded and clamped
//   spectrum  (STRIPS, SLOTS, 2, 2, LANES) stored   strip of columns; vertical frequency; half of the strip; real or
//                                               imaginary; column. half where HALF_SPECTRUM, else real
//   filtered  like spectrum                     may be the spectrum itself
//   filter    (SLOTS / LANES, NX, 2, LANES) real   block of vertical frequencies; horizontal ones, digit-reversed;
//                                               times the scale below. Or null:
//   otf       (.., 2) real                      1-D OTFs, DC first, from number `otf_from` on; real where Nyquist is
//   bin       (NX + SLOTS) int                  where the H of a place is among them: along x, then along y
//   position  (2, SLOTS) int                    where a slot's frequency k, and NY - k, lie after the passes
//   row_blend (NX - COLS) real, column_blend (NY - ROWS) real   share of the near edge in the padding
//   row_turns, column_turns   real              twiddle factors, pass by pass: cos and -sin, q = 1 .. R - 1
//   tasks     (16 * (4 + 3 * work-items)) int   counters of the tasks, 0 before and after
//   first, last               int               steps to do: 0 and 3 for all
//   noise, scale              real              nsr and what the transforms leave undone, lifted (W9)
//
// A work-item's samples lie real, imaginary, real, .. : apart, the strides of a power of two would fill the
// same cache sets twice over.
//
// Defines: VECTOR_BYTES; ROWS, COLS frame; NX, NY padded; STRIPS of columns; HELD frequencies of a column of the
// frame, SLOTS that number in whole blocks of LANES; IN_TYPE, OUT_TYPE; OUT_LIMIT the largest code of an integer
// output, 0 for a real one; STREAM_SPECTRUM: the caches cannot hold it; STREAM_IMAGE: nor this, and its strips are
// whole lines; HALF_SPECTRUM; STORED_LEVEL grey levels to a stored one, 1 but for half. The passes come from the
// generated lists: ROW_FIRST, then ROW_MIDDLE and ROW_LAST in each part of ROW_INNER samples; likewise columns.
//
// One work-item a processor core, each taking tasks until there are none; local size 1; no local memory, no barriers.
// A launch of one step is safe on any device; of several where work-items of one launch see each other's global
// writes after atomics, as they do on processors. Private memory: two vectors for each sample of a row or column,
// and H along x.
// Error: below 4e-7 (float) and 1e-15 (double), relative L2, 8 x 8 to 1024 x 1024, PoCL and Intel's runtime.

#include "restore_transpose.h"
#include "restore_butterflies.h"
#include "wiener_lift.h"

#define STRIP (2 * LANES)

// Rows of a frame start anywhere: these promise no more than their element's alignment.
typedef JOIN(IN_TYPE, LANES)  in_vec  __attribute__((aligned(IN_BYTES)));
typedef JOIN(OUT_TYPE, LANES) out_vec __attribute__((aligned(OUT_BYTES)));

#if HALF_SPECTRUM && __has_builtin(__builtin_convertvector) && !PORTABLE
typedef half stored __attribute__((ext_vector_type(LANES)));
#define GET(P, I)    __builtin_convertvector((P)[I], vec)
#define PUT(P, I, V) (P)[I] = __builtin_convertvector(V, stored)
#elif HALF_SPECTRUM
typedef struct { ushort bits[LANES]; } stored;
#define GET(P, I)    JOIN(vload_half, LANES)(I, (__global const half *)(P))
#define PUT(P, I, V) JOIN(vstore_half, LANES)(V, I, (__global half *)(P))
#else
typedef vec stored;
#define GET(P, I)    (P)[I]
#define PUT(P, I, V) (P)[I] = V
#endif

// Half holds up to 65504: a stored spectrum is scaled to the range of the pixels, and by STORED_LEVEL into half's.
#if HALF_SPECTRUM
#define SCALED(V) ((V) * (vec)(REAL_C(0.5) / (NY * STORED_LEVEL)))
#else
#define SCALED(V) (V)
#endif

// The next strips of a row lie far apart, where no processor looks ahead.
#if __has_builtin(__builtin_prefetch) && !PORTABLE
#define PREFETCH(P) __builtin_prefetch(P)
#else
#define PREFETCH(P)
#endif

// Stores past the caches, to lines that are written whole.
#if __has_builtin(__builtin_nontemporal_store)
#define STREAM(P, V) __builtin_nontemporal_store(V, P)
#else
#define STREAM(P, V) *(P) = V
#endif
#if STREAM_SPECTRUM && !HALF_SPECTRUM
#define PUT_FAR(P, I, V) STREAM((P) + (I), V)
#else
#define PUT_FAR(P, I, V) PUT(P, I, V)
#endif

// ---- pixels -----------------------------------------------------------------------------------------------

ALWAYS_INLINE vec restore_pixels(__global const IN_TYPE *frame, const int row, const int col)
{
    return CONVERT(*(__global const in_vec *)(frame + (size_t)row * COLS + col), SCALAR);
}

ALWAYS_INLINE vec restore_level(const vec v)
{
    vec level = v * (vec)(STORED_LEVEL);
#if OUT_LIMIT
    level = level > (vec)(0) ? level : (vec)(0);
    level = (level < (vec)(OUT_LIMIT) ? level : (vec)(OUT_LIMIT)) + REAL_C(0.5);    // the conversion truncates
#endif
    return level;
}

ALWAYS_INLINE void restore_store(__global OUT_TYPE *image, const int row, const int col, const vec v)
{
    __global OUT_TYPE *to = image + (size_t)row * COLS + col;
    if (STREAM_IMAGE)
        STREAM((__global JOIN(OUT_TYPE, LANES) *)to, CONVERT(restore_level(v), OUT_TYPE));
    else
        *(__global out_vec *)to = CONVERT(restore_level(v), OUT_TYPE);
}

#if COLS % STRIP
// The last strip, of fewer columns, pixel by pixel; 0 beyond the frame.
ALWAYS_INLINE void restore_gather(vec *work, __global const IN_TYPE *frame, const int col,
                                  __global const real *column_blend)
{
    for (int y = 0; y < ROWS; ++y) {
        vec v[2] = {(vec)(0), (vec)(0)};
        for (int i = 0; i < COLS - col; ++i) ((real *)v)[i] = (real)frame[(size_t)y * COLS + col + i];
        work[2 * y] = v[0];
        work[2 * y + 1] = v[1];
    }
    for (int y = 2 * ROWS; y < 2 * NY; ++y) {
        const vec far = work[2 * ROWS - 2 + y % 2];
        work[y] = far + column_blend[y / 2 - ROWS] * (work[y % 2] - far);
    }
}

ALWAYS_INLINE void restore_scatter(const vec *work, __global OUT_TYPE *image, const int col)
{
    for (int y = 0; y < ROWS; ++y) {
        const vec v[2] = {restore_level(work[2 * y]), restore_level(work[2 * y + 1])};
        for (int i = 0; i < COLS - col; ++i) image[(size_t)y * COLS + col + i] = (OUT_TYPE)((const real *)v)[i];
    }
}
#endif

// ---- passes -----------------------------------------------------------------------------------------------

// Forward, a butterfly is followed by turns of exp(-2 pi i j q / (R M)); back, it follows the opposite turns.
#define RESTORE_DEFINE_PASSES(R)                                                                            \
    ALWAYS_INLINE void restore_turn##R(vec *xr, vec *xi, __global const real *turns)                        \
    {                                                                                                       \
        _Pragma("unroll")                                                                                   \
        for (int q = 1; q < R; ++q) {                                                                       \
            const real c = turns[2 * q - 2], s = turns[2 * q - 1];                                          \
            const vec r = xr[q];                                                                            \
            xr[q] = r * c - xi[q] * s;                                                                      \
            xi[q] = r * s + xi[q] * c;                                                                      \
        }                                                                                                   \
    }                                                                                                       \
    ALWAYS_INLINE void restore_turn_back##R(vec *xr, vec *xi, __global const real *turns)                   \
    {                                                                                                       \
        _Pragma("unroll")                                                                                   \
        for (int q = 1; q < R; ++q) {                                                                       \
            const real c = turns[2 * q - 2], s = turns[2 * q - 1];                                          \
            const vec r = xr[q];                                                                            \
            xr[q] = r * c + xi[q] * s;                                                                      \
            xi[q] = xi[q] * c - r * s;                                                                      \
        }                                                                                                   \
    }                                                                                                       \
    ALWAYS_INLINE void restore_get##R(const vec *work, const int m, vec *xr, vec *xi)                       \
    {                                                                                                       \
        _Pragma("unroll")                                                                                   \
        for (int q = 0; q < R; ++q) {                                                                       \
            xr[q] = work[2 * q * m];                                                                        \
            xi[q] = work[2 * q * m + 1];                                                                    \
        }                                                                                                   \
    }                                                                                                       \
    ALWAYS_INLINE void restore_put##R(vec *work, const int m, const vec *xr, const vec *xi)                 \
    {                                                                                                       \
        _Pragma("unroll")                                                                                   \
        for (int q = 0; q < R; ++q) {                                                                       \
            work[2 * q * m] = xr[q];                                                                        \
            work[2 * q * m + 1] = xi[q];                                                                    \
        }                                                                                                   \
    }                                                                                                       \
    ALWAYS_INLINE void restore_forward##R(vec *work, const int length, const int m,                         \
                                          __global const real *turns)                                       \
    {                                                                                                       \
        for (int b = 0; b < length; b += R * m)                                                             \
            for (int j = 0; j < m; ++j) {                                                                   \
                vec xr[R], xi[R];                                                                           \
                restore_get##R(work + 2 * (b + j), m, xr, xi);                                              \
                restore_radix##R(xr, xi);                                                                   \
                if (m > 1) restore_turn##R(xr, xi, turns + 2 * j * (R - 1));                                \
                restore_put##R(work + 2 * (b + j), m, xr, xi);                                              \
            }                                                                                               \
    }                                                                                                       \
    ALWAYS_INLINE void restore_back##R(vec *work, const int length, const int m,                            \
                                       __global const real *turns)                                          \
    {                                                                                                       \
        for (int b = 0; b < length; b += R * m)                                                             \
            for (int j = 0; j < m; ++j) {                                                                   \
                vec xr[R], xi[R];                                                                           \
                restore_get##R(work + 2 * (b + j), m, xr, xi);                                              \
                if (m > 1) restore_turn_back##R(xr, xi, turns + 2 * j * (R - 1));                           \
                restore_radix##R(xi, xr);                                                                   \
                restore_put##R(work + 2 * (b + j), m, xr, xi);                                              \
            }                                                                                               \
    }                                                                                                       \
    /* The first pass down a strip of columns; the rows of the padding are made from the first and last. */ \
    ALWAYS_INLINE void restore_load##R(vec *work, const int m, __global const real *turns,                  \
                                       __global const IN_TYPE *frame, const int col,                        \
                                       __global const real *column_blend)                                   \
    {                                                                                                       \
        const vec near_r = restore_pixels(frame, 0, col), near_i = restore_pixels(frame, 0, col + LANES);   \
        const vec far_r = restore_pixels(frame, ROWS - 1, col);                                             \
        const vec far_i = restore_pixels(frame, ROWS - 1, col + LANES);                                     \
        for (int j = 0; j < m; ++j) {                                                                       \
            vec xr[R], xi[R];                                                                               \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const int y = j + q * m;                                                                    \
                if ((q + 1) * m <= ROWS || y < ROWS) {                                                      \
                    xr[q] = restore_pixels(frame, y, col);                                                  \
                    xi[q] = restore_pixels(frame, y, col + LANES);                                          \
                } else {                                                                                    \
                    const real w = column_blend[y - ROWS];                                                  \
                    xr[q] = far_r + w * (near_r - far_r);                                                   \
                    xi[q] = far_i + w * (near_i - far_i);                                                   \
                }                                                                                           \
            }                                                                                               \
            restore_radix##R(xr, xi);                                                                       \
            restore_turn##R(xr, xi, turns + 2 * j * (R - 1));                                               \
            restore_put##R(work + 2 * j, m, xr, xi);                                                        \
        }                                                                                                   \
    }                                                                                                       \
    ALWAYS_INLINE void restore_unload##R(const vec *work, const int m, __global const real *turns,          \
                                         __global OUT_TYPE *image, const int col)                           \
    {                                                                                                       \
        for (int j = 0; j < m; ++j) {                                                                       \
            vec xr[R], xi[R];                                                                               \
            restore_get##R(work + 2 * j, m, xr, xi);                                                        \
            restore_turn_back##R(xr, xi, turns + 2 * j * (R - 1));                                          \
            restore_radix##R(xi, xr);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const int y = j + q * m;                                                                    \
                if ((q + 1) * m <= ROWS || y < ROWS) {                                                      \
                    restore_store(image, y, col, xr[q]);                                                    \
                    restore_store(image, y, col + LANES, xi[q]);                                            \
                }                                                                                           \
            }                                                                                               \
        }                                                                                                   \
    }                                                                                                       \
    /* The last pass forward, the filter and the first pass back, without leaving the registers. */         \
    ALWAYS_INLINE void restore_filter##R(vec *work, const int length, __global const vec *filter)           \
    {                                                                                                       \
        for (int b = 0; b < length; b += R) {                                                               \
            vec xr[R], xi[R];                                                                               \
            restore_get##R(work + 2 * b, 1, xr, xi);                                                        \
            restore_radix##R(xr, xi);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const vec fr = filter[2 * (b + q)], fi = filter[2 * (b + q) + 1], r = xr[q];                \
                xr[q] = r * fr - xi[q] * fi;                                                                \
                xi[q] = r * fi + xi[q] * fr;                                                                \
            }                                                                                               \
            restore_radix##R(xi, xr);                                                                       \
            restore_put##R(work + 2 * b, 1, xr, xi);                                                        \
        }                                                                                                   \
    }                                                                                                       \
    ALWAYS_INLINE void restore_wiener##R(vec *work, const int length, const real *along,                    \
                                         const vec hr, const vec hi, const real noise, const real scale)    \
    {                                                                                                       \
        const vec short_power = hr * hr + hi * hi;                                                          \
        for (int b = 0; b < length; b += R) {                                                               \
            vec xr[R], xi[R];                                                                               \
            restore_get##R(work + 2 * b, 1, xr, xi);                                                        \
            restore_radix##R(xr, xi);                                                                       \
            _Pragma("unroll")                                                                               \
            for (int q = 0; q < R; ++q) {                                                                   \
                const real gr = along[2 * (b + q)], gi = along[2 * (b + q) + 1];                            \
                const vec power = (gr * gr + gi * gi) * short_power + noise;                                \
                const vec share = power > (vec)(REAL_LEAST) ? scale / power : (vec)(0);                     \
                const vec tr = xr[q] * gr + xi[q] * gi, ti = xi[q] * gr - xr[q] * gi;                       \
                xr[q] = (tr * hr + ti * hi) * share;                                                        \
                xi[q] = (ti * hr - tr * hi) * share;                                                        \
            }                                                                                               \
            restore_radix##R(xi, xr);                                                                       \
            restore_put##R(work + 2 * b, 1, xr, xi);                                                        \
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

#define COLUMN_LOAD(R, M, T)    restore_load##R(work, M, column_turns + T, frame, col, column_blend);
#define COLUMN_FORWARD(R, M, T) restore_forward##R(part, length, M, column_turns + T);
#define COLUMN_BACK(R, M, T)    restore_back##R(part, length, M, column_turns + T);
#define COLUMN_UNLOAD(R, M, T)  restore_unload##R(work, M, column_turns + T, image, col);
#define ROW_FORWARD(R, M, T)    restore_forward##R(part, length, M, row_turns + T);
#define ROW_BACK(R, M, T)       restore_back##R(part, length, M, row_turns + T);
#define ROW_FILTER(R, M, T)     restore_filter##R(part, length, block_filter + 2 * b);
#define ROW_WIENER(R, M, T)     restore_wiener##R(part, length, along + 2 * b, hr.all, hi.all, noise, scale);

// ---- steps ------------------------------------------------------------------------------------------------

// Calls: inlined into one kernel, the three keep a compiler busy for minutes.
#define STEP static WIDE __attribute__((noinline))

// Columns `strip` * STRIP onward to their spectra: the first LANES as real parts, the next as imaginary parts.
STEP void restore_columns_forward(vec *work, const int strip, __global const IN_TYPE *frame,
                                  __global stored *spectrum, __global const int *position,
                                  __global const real *column_turns, __global const real *column_blend)
{
    const int col = STRIP * strip;
#if COLS % STRIP
    if (col + STRIP > COLS) {
        vec *part = work;
        const int length = NY;
        restore_gather(work, frame, col, column_blend);
        COLUMN_FIRST(COLUMN_FORWARD)
    } else
#endif
    {
        COLUMN_FIRST(COLUMN_LOAD)
    }
    for (int b = 0; b < NY; b += COLUMN_INNER) {
        vec *part = work + 2 * b;
        const int length = COLUMN_INNER;
        COLUMN_MIDDLE(COLUMN_FORWARD)
        COLUMN_LAST(COLUMN_FORWARD)
    }
    // Two real columns in one complex transform come apart by symmetry; the factor 1/2 is in the scale.
    __global stored *out = spectrum + 4 * (size_t)SLOTS * strip;
    for (int i = 0; i < HELD; ++i) {
        const vec *p = work + 2 * position[i], *q = work + 2 * position[SLOTS + i];
        PUT_FAR(out, 4 * i, SCALED(p[0] + q[0]));
        PUT_FAR(out, 4 * i + 1, SCALED(p[1] - q[1]));
        PUT_FAR(out, 4 * i + 2, SCALED(p[1] + q[1]));
        PUT_FAR(out, 4 * i + 3, SCALED(q[0] - p[0]));
    }
    for (int i = 4 * HELD; i < 4 * SLOTS; ++i) PUT_FAR(out, i, (vec)(0));
}

// LANES vertical frequencies there and back; the columns of the padding are made here. `along` is H along x, in the
// order the passes leave, `otf` and `bin` are those of the vertical frequencies.
STEP void restore_rows(vec *work, const size_t block, __global const stored *spectrum,
                       __global stored *filtered, __global const vec *filter,
                       const real *along, __global const real *otf, __global const int *bin,
                       __global const real *row_turns, __global const real *row_blend,
                       const real noise, const real scale)
{
    vec r[LANES], i[LANES];
    for (int x = 0; x < STRIPS * STRIP; x += LANES) {
        __global const stored *in = spectrum + 4 * (x / STRIP * SLOTS + block * LANES) + x / LANES % 2 * 2;
        _Pragma("unroll")
        for (int k = 0; k < LANES; ++k) {
            PREFETCH(in + 8 * SLOTS + 4 * k);
            r[k] = GET(in, 4 * k);
            i[k] = GET(in, 4 * k + 1);
        }
        restore_transpose(r);
        restore_transpose(i);
        _Pragma("unroll")
        for (int k = 0; k < LANES; ++k) {
            work[2 * (x + k)] = r[k];
            work[2 * (x + k) + 1] = i[k];
        }
    }
    for (int x = COLS; x < NX; ++x) {
        const real w = row_blend[x - COLS];
        work[2 * x] = work[2 * COLS - 2] + w * (work[0] - work[2 * COLS - 2]);
        work[2 * x + 1] = work[2 * COLS - 1] + w * (work[1] - work[2 * COLS - 1]);
    }
    {
        vec *part = work;
        const int length = NX;
        ROW_FIRST(ROW_FORWARD)
    }
    __global const vec *block_filter = filter + 2 * block * NX;
    union { vec all; real of[LANES]; } hr = {0}, hi = {0};
    if (!filter) {
        for (int k = 0; k < LANES; ++k) {
            const int at = 2 * bin[block * LANES + k];
            hr.of[k] = WIENER_LIFT * otf[at];
            hi.of[k] = WIENER_LIFT * otf[at + 1];
        }
    }
    for (int b = 0; b < NX; b += ROW_INNER) {
        vec *part = work + 2 * b;
        const int length = ROW_INNER;
        ROW_MIDDLE(ROW_FORWARD)
        if (filter) {
            ROW_LAST(ROW_FILTER)
        } else {
            ROW_LAST(ROW_WIENER)
        }
        ROW_MIDDLE_BACK(ROW_BACK)
    }
    {
        vec *part = work;
        const int length = NX;
        ROW_FIRST(ROW_BACK)
    }
    for (int x = 0; x < STRIPS * STRIP; x += LANES) {
        __global stored *out = filtered + 4 * (x / STRIP * SLOTS + block * LANES) + x / LANES % 2 * 2;
        _Pragma("unroll")
        for (int k = 0; k < LANES; ++k) {
            r[k] = work[2 * (x + k)];
            i[k] = work[2 * (x + k) + 1];
        }
        restore_transpose(r);
        restore_transpose(i);
        _Pragma("unroll")
        for (int k = 0; k < LANES; ++k) {
            PUT(out, 4 * k, r[k]);
            PUT(out, 4 * k + 1, i[k]);
        }
    }
}

// Columns `strip` * STRIP onward from their spectra: the same pairs, the same order, backwards.
STEP void restore_columns_inverse(vec *work, const int strip, __global const stored *filtered,
                                  __global OUT_TYPE *image, __global const int *position,
                                  __global const real *column_turns)
{
    const int col = STRIP * strip;
    __global const stored *in = filtered + 4 * (size_t)SLOTS * strip;
    for (int i = 0; i < HELD; ++i) {
        vec *p = work + 2 * position[i], *q = work + 2 * position[SLOTS + i];
        const vec ar = GET(in, 4 * i), ai = GET(in, 4 * i + 1), br = GET(in, 4 * i + 2), bi = GET(in, 4 * i + 3);
        q[0] = ar + bi;
        q[1] = br - ai;
        p[0] = p == q ? ar : ar - bi;     // a bin that mirrors itself is real
        p[1] = p == q ? br : ai + br;
    }
    for (int b = 0; b < NY; b += COLUMN_INNER) {
        vec *part = work + 2 * b;
        const int length = COLUMN_INNER;
        COLUMN_LAST(COLUMN_BACK)
        COLUMN_MIDDLE_BACK(COLUMN_BACK)
    }
#if COLS % STRIP
    if (col + STRIP > COLS) {
        vec *part = work;
        const int length = NY;
        COLUMN_FIRST(COLUMN_BACK)
        restore_scatter(work, image, col);
    } else
#endif
    {
        COLUMN_FIRST(COLUMN_UNLOAD)
    }
}

// ---- the kernel -------------------------------------------------------------------------------------------

#define STEPS 3
#define WORK  (2 * (STRIPS * STRIP > NX ? (STRIPS * STRIP > NY ? STRIPS * STRIP : NY) : (NX > NY ? NX : NY)))

// Counters stand a cache line apart.
#define TAKEN(STEP, OWNER) (tasks + 16 * (STEPS + 1 + (STEP) * (int)get_global_size(0) + (OWNER)))
#define DONE(STEP)         (tasks + 16 * (STEP))
#define GONE               (tasks + 16 * STEPS)

// Steps `first` to `last` - 1. Each work-item does its share of a step's tasks, then takes of the others' shares;
// it begins a step when all tasks of the one before are done. So it waits only for what another is doing at that
// moment, never for one that has not begun: any number of them at a time, one by one too, come to the end.
__kernel WIDE void __attribute__((reqd_work_group_size(1, 1, 1)))
restore_frame(
    __global const IN_TYPE *frame,
    __global stored        *spectrum,
    __global stored        *filtered,
    __global OUT_TYPE      *image,
    __global const vec     *filter,
    __global const real    *otf,
    __global const int     *bin,
    __global const int     *position,
    __global const real    *column_turns,
    __global const real    *column_blend,
    __global const real    *row_turns,
    __global const real    *row_blend,
    __global int           *tasks,
    const int first, const int last, const int otf_from,
    const real noise, const real scale)
{
    vec work[WORK];
    real along[2 * NX];
    const int workers = get_global_size(0), self = get_global_id(0);
    for (int step = first; step < last; ++step) {
        if (step > first) {
            const int before = step == 2 ? SLOTS / LANES : STRIPS;
            while (*(volatile __global int *)DONE(step - 1) < before) {}
            atomic_add(DONE(step - 1), 0);      // what was written before the count is seen after it
        }
        if (step == 1 && !filter)
            for (int x = 0; x < NX; ++x) {
                along[2 * x] = WIENER_LIFT * otf[2 * (otf_from + bin[x])];
                along[2 * x + 1] = WIENER_LIFT * otf[2 * (otf_from + bin[x]) + 1];
            }
        const int count = step == 1 ? SLOTS / LANES : STRIPS;
        for (int turn = 0; turn < workers; ++turn) {
            const int owner = (self + turn) % workers;
            const int start = owner * count / workers, end = (owner + 1) * count / workers;
            for (int task = start + atomic_inc(TAKEN(step, owner)); task < end;
                 task = start + atomic_inc(TAKEN(step, owner))) {
                if (step == 0)
                    restore_columns_forward(work, task, frame, spectrum, position, column_turns, column_blend);
                else if (step == 1)
                    restore_rows(work, task, spectrum, filtered, filter, along, otf + 2 * otf_from, bin + NX,
                                 row_turns, row_blend, noise, scale);
                else
                    restore_columns_inverse(work, task, filtered, image, position, column_turns);
                mem_fence(CLK_GLOBAL_MEM_FENCE);
                atomic_inc(DONE(step));
            }
        }
    }
    if (atomic_inc(GONE) == workers - 1)        // the last leaves the counters as they were
        for (int i = 0; i <= STEPS + STEPS * workers; ++i) tasks[16 * i] = 0;
}
