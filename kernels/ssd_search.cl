// ssd_search.cl : find many templates in one image, each in its own window, in one launch or two.
//
//   score "ssd"          SSD(o) = sum_r (I(o + r) - T(r))^2                       docs/maths.md, eq. S2, S3
//   score "gain_offset"  R(o) = min over g >= 0, b of sum_r (g I(o + r) + b - T(r))^2 / sum_r (T(r) - mean T)^2
//                             = 1 - max(rho, 0)^2                                  docs/maths.md, eq. S5, S6
//   best(o)              the smallest score; of equals the first in row-major order
//
//   image       (image_rows, image_columns) pixel   uchar, ushort or float, as IMAGE_KIND says
//   templates   (count, TEMPLATE_ROWS, TEMPLATE_COLUMNS) float   T; less its mean for gain_offset of other than uchar
//   sums        (count, 2) int     uchar: sum T, sum T^2; else: bits of the float sum T'^2 of the stored T', unused
//   origins     (count, 2) int     row, column of each window's corner; the host keeps windows inside the image
//   scores      (count, offset_rows, map_columns) int       offset_columns in each row, rounded up to whole tiles; ssd of
//                                                      uchar: the integer; else the bits of a float >= 0
//   tile_best   (count, tiles, 2) int                       a tile's smallest score and its row-major place in the map
//   records     (count, 11 + PATCH_ROWS * PATCH_COLUMNS) int   row, column of the best place in the image; the 3 x 3
//                                                      scores around it; the pixels around it as bits of floats
//   All scores are >= 0, so their bits order as integers do; NaN becomes infinity, and a score outside the offsets is
//   SCORE_NONE.
//
// Family "lanes" (VECTOR_BYTES > 0): a work-item owns a tile of TILE_ROWS x TILE_COLUMNS offsets, one offset a lane; no
// local memory, no barrier. Its part of the window is copied once to private memory; BLOCK_ROWS x VECTORS vectors of
// sums stay in registers while the template passes by. The only tile of a window writes the record itself.
// Family "groups" (VECTOR_BYTES == 0): a work-group of GROUP_COLUMNS x GROUP_ROWS items shares a window in local memory
// (TILE_ROWS + TEMPLATE_ROWS - 1) x (TILE_COLUMNS + TEMPLATE_COLUMNS - 1) pixels; an item owns ITEM_ROWS offsets
// below each other and holds their window values in registers; one barrier, then a tree for the smallest.
// ssd_search_best: the record from the best of all tiles, by one work-item (lanes) or work-group (groups) a template.
//
// Error: uchar ssd exact. Float ssd below (TEMPLATE_ROWS + TEMPLATE_COLUMNS + 2) / 2 eps relative, for it sums row by
// row. gain_offset: uchar sums exact, then (8 + 4 TAPS/s) eps absolute, s the root of both centred sums of squares;
// else (2 (rows + columns) + 4 span + 12) eps absolute, span the window's range in standard deviations of the place.

#include "lanes.h"

#ifndef IMAGE_KIND
#define IMAGE_KIND 0          // 0 uchar, 1 ushort, 2 float
#endif
#ifndef GAIN_OFFSET
#define GAIN_OFFSET 0         // 1: score "gain_offset"
#endif
#ifndef TEMPLATE_ROWS
#define TEMPLATE_ROWS 20
#endif
#ifndef TEMPLATE_COLUMNS
#define TEMPLATE_COLUMNS 20
#endif
#ifndef BLOCK_ROWS
#define BLOCK_ROWS 3          // lanes: offset rows of a block
#endif
#ifndef VECTORS
#define VECTORS 3             // lanes: vectors across; BLOCK_ROWS * VECTORS sums must fit the registers
#endif
#ifndef PATCH_MARGIN
#define PATCH_MARGIN 0        // pixels around the template in the record's patch; negative: no patch
#endif

#define TAPS (TEMPLATE_ROWS * TEMPLATE_COLUMNS)
#define LEAST_VARIANCE 1e-30f // times TAPS: below it squares lose digits, and a footprint counts as flat
#define SCORE_NONE 0x7fffffff
#if PATCH_MARGIN < 0
#define PATCH_ROWS 0
#define PATCH_COLUMNS 0
#else
#define PATCH_ROWS (TEMPLATE_ROWS + 2 * PATCH_MARGIN)
#define PATCH_COLUMNS (TEMPLATE_COLUMNS + 2 * PATCH_MARGIN)
#endif
#define RECORD (11 + PATCH_ROWS * PATCH_COLUMNS)

#if IMAGE_KIND == 0
#define PIXEL uchar
#elif IMAGE_KIND == 1
#define PIXEL ushort
#else
#define PIXEL float
#endif
typedef PIXEL pixel;

#if VECTOR_BYTES
typedef JOIN(int, LANES) ivec;
#define AS_IVEC(V) JOIN(as_int, LANES)(V)
#else
typedef int ivec;
#define AS_IVEC(V) as_int(V)
#endif

// What sums are made in: integers stay exact.
#if IMAGE_KIND == 0
typedef int number;
typedef ivec numbers;
#else
typedef float number;
typedef vec numbers;
#endif

// ---- scores -------------------------------------------------------------------------------------------------

#if GAIN_OFFSET
// Eq. S5, from n times the covariance and the variances.
ALWAYS_INLINE vec gain_offset_score(const vec covariance, const vec image_variance, const float template_variance)
{
    const vec residual = 1.0f - (covariance / image_variance) * (covariance / template_variance);
    const vec score = residual > 0.0f ? residual : (vec)0.0f;
    return ((covariance > 0.0f) & (image_variance > LEAST_VARIANCE)) ? score : (vec)1.0f;
}
#endif

#if GAIN_OFFSET && IMAGE_KIND == 0
// Eq. S6: the sums are first moved, exactly, to about the footprint's own mean, so that what is left to subtract is at
// most TAPS and float32 loses nothing.
ALWAYS_INLINE ivec gain_offset_bits(
    const ivec image_1, const ivec image_2, const ivec cross, const int template_1, const int template_2)
{
    const ivec mean = CONVERT(CONVERT(image_1, float) * (1.0f / TAPS), int);
    const ivec rest = image_1 - mean * TAPS;
    const int template_mean = template_1 / TAPS;
    const int template_rest = template_1 - template_mean * TAPS;
    const vec image_variance = CONVERT(image_2 - mean * (image_1 + rest), float)
                               - CONVERT(rest, float) * CONVERT(rest, float) * (1.0f / TAPS);
    const float template_variance = (float)(template_2 - template_mean * (template_1 + template_rest))
                                    - (float)template_rest * (float)template_rest * (1.0f / TAPS);
    const vec covariance = CONVERT(cross - mean * template_rest - image_1 * template_mean, float)
                           - CONVERT(rest, float) * ((float)template_rest * (1.0f / TAPS));
    return AS_IVEC(gain_offset_score(covariance, image_variance, template_variance));
}
#endif

#if IMAGE_KIND != 0
// A footprint that holds NaN or infinity matches nothing.
ALWAYS_INLINE ivec score_bits(const vec value)
{
    return AS_IVEC(value >= 0.0f ? value : (vec)INFINITY);
}
#endif

#if GAIN_OFFSET && IMAGE_KIND != 0
ALWAYS_INLINE ivec centred_bits(const vec covariance, const vec image_variance, const float template_variance)
{
    const vec score = gain_offset_score(covariance, image_variance, template_variance);
    return score_bits(image_variance < INFINITY ? score : (vec)INFINITY);
}

// A grey level of the window, so that means taken from it lose nothing; the same for all tiles of a window.
ALWAYS_INLINE float window_level(__global const pixel *image, __global const int *origin, const int image_columns,
                                 const int offset_rows, const int offset_columns)
{
    const int row = origin[0] + (offset_rows + TEMPLATE_ROWS - 1) / 2;
    const float middle = (float)image[row * image_columns + origin[1] + (offset_columns + TEMPLATE_COLUMNS - 1) / 2];
    return middle - middle == 0.0f ? middle : 0.0f;   // not NaN, not infinite
}
#endif

// The index nearest to `i` of 0 to n - 1; clamp is a call on some compilers.
ALWAYS_INLINE int nearest(const int i, const int n)
{
    return i < 0 ? 0 : i < n ? i : n - 1;
}

// One work-item of `items` writes its share of a template's record: where the best place lies, the scores around it,
// and the pixels; beyond the image's edge these repeat the last one.
ALWAYS_INLINE void write_record(
    __global int *record, __global const pixel *image, __global const int *origin, __global const int *map,
    const int place, const int image_rows, const int image_columns, const int offset_rows, const int offset_columns,
    const int map_columns, const int item, const int items)
{
    const int y = place / map_columns;
    const int x = place - y * map_columns;
    const int top = origin[0] + y;
    const int left = origin[1] + x;
    if (item == 0) {
        record[0] = top;
        record[1] = left;
        for (int ny = y - 1; ny <= y + 1; ++ny) {
            for (int nx = x - 1; nx <= x + 1; ++nx) {
                const int inside = ny >= 0 && ny < offset_rows && nx >= 0 && nx < offset_columns;
                record[2 + 3 * (ny - y + 1) + nx - x + 1] = inside ? map[ny * map_columns + nx] : SCORE_NONE;
            }
        }
    }
#if PATCH_ROWS > 0
    const int start = left - PATCH_MARGIN;
    const int inside = start >= 0 && start + PATCH_COLUMNS <= image_columns;
    for (int r = 0; r < PATCH_ROWS; ++r) {
        __global const pixel *from = image + nearest(top - PATCH_MARGIN + r, image_rows) * image_columns;
        __global int *to = record + 11 + r * PATCH_COLUMNS;
        for (int c = item; c < PATCH_COLUMNS; c += items)
            to[c] = as_int((float)from[inside ? start + c : nearest(start + c, image_columns)]);
    }
#endif
}

#if VECTOR_BYTES
// ---- lanes --------------------------------------------------------------------------------------------------

#ifndef TILE_ROWS
#define TILE_ROWS BLOCK_ROWS  // lanes: a multiple of BLOCK_ROWS
#endif
#ifndef TILE_COLUMNS
#define TILE_COLUMNS (VECTORS * LANES)   // lanes: a multiple of that
#endif
#define WINDOW_ROWS (TILE_ROWS + TEMPLATE_ROWS - 1)
#define PITCH ((TILE_COLUMNS + TEMPLATE_COLUMNS - 1 + LANES - 1) / LANES * LANES)

#if LANES == 16
#define LANE_INDEX ((ivec)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#elif LANES == 8
#define LANE_INDEX ((ivec)(0, 1, 2, 3, 4, 5, 6, 7))
#else
#define LANE_INDEX ((ivec)(0, 1, 2, 3))
#endif

// For every vector of a block.
#define EACH(K, J)                                  \
    _Pragma("unroll")                               \
    for (int K = 0; K < BLOCK_ROWS; ++K)            \
        _Pragma("unroll")                           \
        for (int J = 0; J < VECTORS; ++J)

// Pointer casts with a lowered alignment: vloadN is a call on some compilers.
typedef vec vec_any __attribute__((aligned(4)));
typedef ivec ivec_any __attribute__((aligned(4)));
typedef JOIN(PIXEL, LANES) pixels_any __attribute__((aligned(sizeof(pixel))));

#if IMAGE_KIND == 0
// A cell holds a pixel and its right neighbour, and so does a tap: two products and their sum are one instruction of
// most processors.
#if LANES == 8
typedef short16 cells;
#define AS_LONGS(V) as_ulong4(V)
#elif LANES == 4
typedef short8 cells;
#define AS_LONGS(V) as_ulong2(V)
#else
#error "uchar takes VECTOR_BYTES 16 or 32: no vector of OpenCL C holds 32 shorts"
#endif
typedef short2 cell;
#define CELL_PIXELS 2

// sum + a.even * b.even + a.odd * b.odd, for sums from 0 to 2^31. Added as 64-bit numbers, where then nothing carries
// from half to half: else a compiler adds the two products one after the other and misses that instruction.
ALWAYS_INLINE ivec multiply_add(const ivec sum, const cells a, const cells b)
{
    const ivec products = CONVERT(a.even, int) * CONVERT(b.even, int) + CONVERT(a.odd, int) * CONVERT(b.odd, int);
    return AS_IVEC(AS_LONGS(sum) + AS_LONGS(products));
}
#else
typedef vec cells;
typedef float cell;
#define CELL_PIXELS 1
#endif
typedef cells cells_any __attribute__((aligned(4)));
#define TAP_COLUMNS ((TEMPLATE_COLUMNS + CELL_PIXELS - 1) / CELL_PIXELS)

// The tile's part of the window, less `level`; zero where the window has ended.
ALWAYS_INLINE void copy_window(__global const pixel *corner, const int image_columns, const int rows, const int columns,
                               const float level, cell *window)
{
    const int whole = columns - (IMAGE_KIND == 0);   // of bytes the last has no neighbour
    #pragma unroll 1
    for (int y = 0; y < WINDOW_ROWS; ++y) {
        __global const pixel *from = corner + y * image_columns;
        cell *to = window + y * PITCH;
        #pragma unroll 1
        for (int x = 0; x < PITCH; x += LANES) *(cells *)(to + x) = 0;
        if (y >= rows) continue;
        int x = 0;
        if (whole >= LANES) {
            #pragma unroll 1
            for (; x < whole; x += LANES) {
                const int at = x + LANES <= whole ? x : whole - LANES;   // the last vector overlaps the one before
                cells value;
#if IMAGE_KIND == 0
                value.even = CONVERT(*(__global const pixels_any *)(from + at), short);
                value.odd = CONVERT(*(__global const pixels_any *)(from + at + 1), short);
#else
                value = CONVERT(*(__global const pixels_any *)(from + at), float) - level;
#endif
                *(cells_any *)(to + at) = value;
            }
        }
        #pragma unroll 1
        for (x = x < whole ? x : whole; x < columns; ++x) {
#if IMAGE_KIND == 0
            to[x] = (short2)(from[x], x < whole ? from[x + 1] : 0);
#else
            to[x] = (float)from[x] - level;
#endif
        }
    }
}

#if IMAGE_KIND == 0 || GAIN_OFFSET
// Sums along a row, of TEMPLATE_COLUMNS pixels or their squares.
ALWAYS_INLINE numbers sum_along(const cell *row, const int squared)
{
    cells sum = 0;
    ivec squares = 0;
    #pragma unroll
    for (int c = 0; c < TEMPLATE_COLUMNS; c += CELL_PIXELS) {
        cells value = *(const cells_any *)(row + c);
#if IMAGE_KIND == 0
        if (c + 1 == TEMPLATE_COLUMNS) value.odd = 0;
        if (squared) squares = multiply_add(squares, value, value);
#endif
        sum += value;
    }
#if IMAGE_KIND == 0
    return squared ? squares : CONVERT(sum.even, int) + CONVERT(sum.odd, int);
#else
    return sum;
#endif
}

// Sums over every footprint of the tile, along the rows first and then down: integers each from the one above it.
ALWAYS_INLINE void footprint_sums(const cell *window, const int squared, number *sums)
{
    #pragma unroll 1
    for (int x = 0; x < TILE_COLUMNS; x += LANES) {
        numbers along[WINDOW_ROWS], total;
        #pragma unroll 1
        for (int y = 0; y < WINDOW_ROWS; ++y) along[y] = sum_along(window + y * PITCH + x, squared);
        #pragma unroll 1
        for (int k = 0; k < TILE_ROWS; ++k) {
            if (IMAGE_KIND == 0 && k > 0) {
                total += along[k + TEMPLATE_ROWS - 1] - along[k - 1];
            } else {
                total = 0;
                #pragma unroll 1
                for (int r = 0; r < TEMPLATE_ROWS; ++r) total += along[k + r];
            }
            *(numbers *)(sums + k * TILE_COLUMNS + x) = total;
        }
    }
}
#endif

#if IMAGE_KIND == 0
// Row y of the window is row y - k of the template's footprint k rows down: adds what they share to the block's sums.
ALWAYS_INLINE void correlate_row(const cell *window, const cells *taps, const int y, ivec cross[BLOCK_ROWS][VECTORS])
{
    #pragma unroll 1
    for (int c = 0; c < TAP_COLUMNS; ++c) {
        cells value[VECTORS];
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j)
            value[j] = *(const cells_any *)(window + y * PITCH + c * CELL_PIXELS + j * LANES);
        EACH(k, j)
            if (y - k >= 0 && y - k < TEMPLATE_ROWS)
                cross[k][j] = multiply_add(cross[k][j], value[j], taps[(y - k) * TAP_COLUMNS + c]);
    }
}

// sum I T for a block of offsets, exact.
ALWAYS_INLINE void correlate(const cell *window, const cells *taps, ivec cross[BLOCK_ROWS][VECTORS])
{
    EACH(k, j) cross[k][j] = 0;
    #pragma unroll
    for (int y = 0; y < BLOCK_ROWS - 1; ++y) correlate_row(window, taps, y, cross);
    #pragma unroll 1
    for (int y = BLOCK_ROWS - 1; y < TEMPLATE_ROWS; ++y) correlate_row(window, taps, y, cross);
    #pragma unroll
    for (int y = 0; y < BLOCK_ROWS - 1; ++y)
        correlate_row(window, taps, (TEMPLATE_ROWS > BLOCK_ROWS - 1 ? TEMPLATE_ROWS : BLOCK_ROWS - 1) + y, cross);
}
#elif !GAIN_OFFSET
// Squared differences, summed along a row first and then down, which bounds the rounding error.
ALWAYS_INLINE void squared_differences(const cell *window, __global const float *taps, vec total[BLOCK_ROWS][VECTORS])
{
    EACH(k, j) total[k][j] = 0.0f;
    #pragma unroll 1
    for (int r = 0; r < TEMPLATE_ROWS; ++r) {
        vec along[BLOCK_ROWS][VECTORS];
        EACH(k, j) along[k][j] = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
            const cell *at = window + r * PITCH + c;
            const float tap = taps[r * TEMPLATE_COLUMNS + c];
            EACH(k, j) {
                const vec difference = *(const cells_any *)(at + k * PITCH + j * LANES) - tap;
                along[k][j] += difference * difference;
            }
        }
        EACH(k, j) total[k][j] += along[k][j];
    }
}
#else
// Sums of the footprints less their means, as the expanded form cancels on bright images.
ALWAYS_INLINE void centred_sums(const cell *window, __global const float *taps, const number *sums,
                                vec squares[BLOCK_ROWS][VECTORS], vec cross[BLOCK_ROWS][VECTORS])
{
    vec mean[BLOCK_ROWS][VECTORS];
    EACH(k, j) {
        mean[k][j] = *(const numbers *)(sums + k * TILE_COLUMNS + j * LANES) * (1.0f / TAPS);
        squares[k][j] = cross[k][j] = 0.0f;
    }
    #pragma unroll 1
    for (int r = 0; r < TEMPLATE_ROWS; ++r) {
        vec along[BLOCK_ROWS][VECTORS], across[BLOCK_ROWS][VECTORS];
        EACH(k, j) along[k][j] = across[k][j] = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
            const cell *at = window + r * PITCH + c;
            const float tap = taps[r * TEMPLATE_COLUMNS + c];
            EACH(k, j) {
                const vec value = *(const cells_any *)(at + k * PITCH + j * LANES) - mean[k][j];
                along[k][j] += value * value;
                across[k][j] += tap * value;
            }
        }
        EACH(k, j) {
            squares[k][j] += along[k][j];
            cross[k][j] += across[k][j];
        }
    }
}
#endif

__kernel WIDE void __attribute__((reqd_work_group_size(1, 1, 1)))
ssd_search(
    __global const pixel *image,
    __global const float *templates,
    __global const int   *sums,
    __global const int   *origins,
    __global int         *scores,
    __global int         *tile_best,
    __global int         *records,
    const int image_rows, const int image_columns,
    const int offset_rows, const int offset_columns,
    const int map_columns)
{
    const int x0 = (int)get_global_id(0) * TILE_COLUMNS;
    const int y0 = (int)get_global_id(1) * TILE_ROWS;
    const int index = (int)get_global_id(2);
    __global const int *origin = origins + 2 * index;
    __global const float *taps = templates + index * TAPS;
    __global int *map = scores + index * offset_rows * map_columns;
#if IMAGE_KIND != 0 && GAIN_OFFSET
    const float level = window_level(image, origin, image_columns, offset_rows, offset_columns);
#else
    const float level = 0.0f;
#endif

    cell window[WINDOW_ROWS * PITCH] __attribute__((aligned(64)));
    copy_window(image + (origin[0] + y0) * image_columns + origin[1] + x0, image_columns,
                min(WINDOW_ROWS, offset_rows + TEMPLATE_ROWS - 1 - y0),
                min(TILE_COLUMNS + TEMPLATE_COLUMNS - 1, offset_columns + TEMPLATE_COLUMNS - 1 - x0), level, window);

#if IMAGE_KIND == 0
    cells pairs[TEMPLATE_ROWS * TAP_COLUMNS];   // whole vectors: taps spread at their use miss that instruction too
    #pragma unroll 1
    for (int i = 0; i < TEMPLATE_ROWS * TAP_COLUMNS; ++i) {
        const int c = i % TAP_COLUMNS * 2;
        __global const float *tap = taps + i / TAP_COLUMNS * TEMPLATE_COLUMNS + c;
        pairs[i].even = (short)tap[0];
        pairs[i].odd = c + 1 < TEMPLATE_COLUMNS ? (short)tap[1] : 0;
    }
    number squares[TILE_ROWS * TILE_COLUMNS] __attribute__((aligned(64)));
    footprint_sums(window, 1, squares);
#endif
#if GAIN_OFFSET
    number pixels[TILE_ROWS * TILE_COLUMNS] __attribute__((aligned(64)));
    footprint_sums(window, 0, pixels);
#endif

    const int rows = offset_rows - y0 < TILE_ROWS ? offset_rows - y0 : TILE_ROWS;
    __global int *to = map + y0 * map_columns + x0;
    #pragma unroll 1
    for (int y = 0; y < TILE_ROWS; y += BLOCK_ROWS) {
        #pragma unroll 1
        for (int x = 0; x < TILE_COLUMNS; x += VECTORS * LANES) {
            const cell *corner = window + y * PITCH + x;
            ivec score[BLOCK_ROWS][VECTORS];
#if IMAGE_KIND == 0
            ivec cross[BLOCK_ROWS][VECTORS];
            correlate(corner, pairs, cross);
            EACH(k, j) {
                const int at = (y + k) * TILE_COLUMNS + x + j * LANES;
                const ivec square = *(const numbers *)(squares + at);
#if GAIN_OFFSET
                score[k][j] = gain_offset_bits(*(const numbers *)(pixels + at), square, cross[k][j], sums[2 * index],
                                               sums[2 * index + 1]);
#else
                score[k][j] = square + sums[2 * index + 1] - 2 * cross[k][j];
#endif
            }
#elif GAIN_OFFSET
            vec square[BLOCK_ROWS][VECTORS], cross[BLOCK_ROWS][VECTORS];
            centred_sums(corner, taps, pixels + y * TILE_COLUMNS + x, square, cross);
            EACH(k, j) score[k][j] = centred_bits(cross[k][j], square[k][j], as_float(sums[2 * index]));
#else
            vec total[BLOCK_ROWS][VECTORS];
            squared_differences(corner, taps, total);
            EACH(k, j) score[k][j] = score_bits(total[k][j]);
#endif
            EACH(k, j)
                if (y + k < rows) *(__global ivec_any *)(to + (y + k) * map_columns + x + j * LANES) = score[k][j];
        }
    }

    ivec best = SCORE_NONE, best_at = 0;
    #pragma unroll 1
    for (int y = 0; y < rows; ++y) {
        #pragma unroll 1
        for (int x = 0; x < TILE_COLUMNS; x += LANES) {
            const ivec column = LANE_INDEX + (x0 + x);
            const ivec score = *(__global const ivec_any *)(to + y * map_columns + x);
            const ivec better = (column < offset_columns) & (score < best);
            best = better ? score : best;
            best_at = better ? column + (y0 + y) * map_columns : best_at;
        }
    }

    union { ivec all; int each[LANES]; } value, place;
    value.all = best;
    place.all = best_at;
    int smallest = SCORE_NONE, smallest_at = SCORE_NONE;
    #pragma unroll 1
    for (int i = 0; i < LANES; ++i) {
        if (value.each[i] < smallest || (value.each[i] == smallest && place.each[i] < smallest_at)) {
            smallest = value.each[i];
            smallest_at = place.each[i];
        }
    }
    const int tiles = (int)(get_global_size(0) * get_global_size(1));
    const int tile = (int)(get_global_id(1) * get_global_size(0) + get_global_id(0));
    if (tiles == 1) {
        write_record(records + index * RECORD, image, origin, map, smallest_at, image_rows, image_columns, offset_rows,
                     offset_columns, map_columns, 0, 1);
    } else {
        tile_best[2 * (index * tiles + tile)] = smallest;
        tile_best[2 * (index * tiles + tile) + 1] = smallest_at;
    }
}

#define BEST_ITEMS 1

#else
// ---- groups -------------------------------------------------------------------------------------------------

#define GROUP_COLUMNS 32
#define GROUP_ROWS 4
#define ITEM_ROWS 4
#define GROUP_ITEMS (GROUP_COLUMNS * GROUP_ROWS)
#define TILE_ROWS (GROUP_ROWS * ITEM_ROWS)
#define TILE_COLUMNS GROUP_COLUMNS
#define WINDOW_ROWS (TILE_ROWS + TEMPLATE_ROWS - 1)
#define PITCH (TILE_COLUMNS + TEMPLATE_COLUMNS - 1)
#define BEST_ITEMS 64

// A tree over the items of a group; the smallest score and its place end up at 0, which item 0 may read at once.
ALWAYS_INLINE void keep_smallest(__local int *best, __local int *at, const int item, const int items)
{
    for (int half_items = items / 2; half_items > 0; half_items /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < half_items) {
            const int other = best[item + half_items];
            const int other_at = at[item + half_items];
            if (other < best[item] || (other == best[item] && other_at < at[item])) {
                best[item] = other;
                at[item] = other_at;
            }
        }
    }
}

__kernel void __attribute__((reqd_work_group_size(GROUP_COLUMNS, GROUP_ROWS, 1)))
ssd_search(
    __global const pixel *image,
    __global const float *templates,
    __global const int   *sums,
    __global const int   *origins,
    __global int         *scores,
    __global int         *tile_best,
    __global int         *records,
    const int image_rows, const int image_columns,
    const int offset_rows, const int offset_columns,
    const int map_columns)
{
    const int x0 = (int)get_group_id(0) * TILE_COLUMNS;
    const int y0 = (int)get_group_id(1) * TILE_ROWS;
    const int index = (int)get_group_id(2);
    const int item = (int)(get_local_id(1) * GROUP_COLUMNS + get_local_id(0));

    __local pixel window[WINDOW_ROWS * PITCH];
    __local int local_best[GROUP_ITEMS];
    __local int local_at[GROUP_ITEMS];

    const int rows = min(WINDOW_ROWS, offset_rows + TEMPLATE_ROWS - 1 - y0);
    const int columns = min((int)PITCH, offset_columns + TEMPLATE_COLUMNS - 1 - x0);
    __global const pixel *corner = image + (origins[2 * index] + y0) * image_columns + origins[2 * index + 1] + x0;
    for (int y = (int)get_local_id(1); y < WINDOW_ROWS; y += GROUP_ROWS)
        for (int x = (int)get_local_id(0); x < PITCH; x += GROUP_COLUMNS)
            window[y * PITCH + x] = y < rows && x < columns ? corner[y * image_columns + x] : (pixel)0;
    barrier(CLK_LOCAL_MEM_FENCE);

#if IMAGE_KIND != 0 && GAIN_OFFSET
    const number level = window_level(image, origins + 2 * index, image_columns, offset_rows, offset_columns);
#else
    const number level = 0;
#endif

    const int column = (int)get_local_id(0);
    const int row = (int)get_local_id(1) * ITEM_ROWS;
    __global const float *taps = templates + index * TAPS;
    // Columns outermost and rows innermost: each window value is read once and serves ITEM_ROWS offsets.
#if GAIN_OFFSET
    number total[ITEM_ROWS];
    for (int k = 0; k < ITEM_ROWS; ++k) total[k] = 0;
    for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
        __local const pixel *down = window + row * PITCH + column + c;
        number first = 0;
        for (int r = 0; r < TEMPLATE_ROWS; ++r) first += (number)down[r * PITCH] - level;
        total[0] += first;
        #pragma unroll
        for (int k = 1; k < ITEM_ROWS; ++k) {
#if IMAGE_KIND == 0
            first += (number)down[(k - 1 + TEMPLATE_ROWS) * PITCH] - (number)down[(k - 1) * PITCH];
#else
            first = 0;
            for (int r = k; r < k + TEMPLATE_ROWS; ++r) first += (number)down[r * PITCH] - level;
#endif
            total[k] += first;
        }
    }
    number mean[ITEM_ROWS], squares[ITEM_ROWS], cross[ITEM_ROWS];
    #pragma unroll
    for (int k = 0; k < ITEM_ROWS; ++k) {
#if IMAGE_KIND == 0
        mean[k] = 0;          // integer sums need no mean taken off
#else
        mean[k] = total[k] * (1.0f / TAPS);
#endif
        squares[k] = cross[k] = 0;
    }
#else
    number squares[ITEM_ROWS];
    #pragma unroll
    for (int k = 0; k < ITEM_ROWS; ++k) squares[k] = 0;
#endif
    for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
        __local const pixel *down = window + row * PITCH + column + c;
        number held[ITEM_ROWS], along[ITEM_ROWS];
        #pragma unroll
        for (int k = 0; k < ITEM_ROWS - 1; ++k) held[k] = (number)down[k * PITCH] - level;
        #pragma unroll
        for (int k = 0; k < ITEM_ROWS; ++k) along[k] = 0;
#if GAIN_OFFSET
        number across[ITEM_ROWS];
        #pragma unroll
        for (int k = 0; k < ITEM_ROWS; ++k) across[k] = 0;
#endif
        for (int r = 0; r < TEMPLATE_ROWS; ++r) {
            held[ITEM_ROWS - 1] = (number)down[(r + ITEM_ROWS - 1) * PITCH] - level;
            const number tap = (number)taps[r * TEMPLATE_COLUMNS + c];
            #pragma unroll
            for (int k = 0; k < ITEM_ROWS; ++k) {
#if GAIN_OFFSET
                const number value = held[k] - mean[k];
                along[k] += value * value;
                across[k] += tap * value;
#else
                const number difference = held[k] - tap;
                along[k] += difference * difference;
#endif
            }
            #pragma unroll
            for (int k = 0; k < ITEM_ROWS - 1; ++k) held[k] = held[k + 1];
        }
        #pragma unroll
        for (int k = 0; k < ITEM_ROWS; ++k) {
            squares[k] += along[k];
#if GAIN_OFFSET
            cross[k] += across[k];
#endif
        }
    }

    int smallest = SCORE_NONE, smallest_at = SCORE_NONE;
    for (int k = 0; k < ITEM_ROWS; ++k) {
        const int y = y0 + row + k;
        const int x = x0 + column;
        if (y >= offset_rows || x >= offset_columns) continue;
#if IMAGE_KIND == 0 && GAIN_OFFSET
        const int score = gain_offset_bits(total[k], squares[k], cross[k], sums[2 * index], sums[2 * index + 1]);
#elif IMAGE_KIND == 0
        const int score = squares[k];
#elif GAIN_OFFSET
        const int score = centred_bits(cross[k], squares[k], as_float(sums[2 * index]));
#else
        const int score = score_bits(squares[k]);
#endif
        const int place = y * map_columns + x;
        scores[index * offset_rows * map_columns + place] = score;
        if (score < smallest) {
            smallest = score;
            smallest_at = place;
        }
    }

    local_best[item] = smallest;
    local_at[item] = smallest_at;
    keep_smallest(local_best, local_at, item, GROUP_ITEMS);
    if (item == 0) {
        const int tiles = (int)(get_num_groups(0) * get_num_groups(1));
        const int tile = (int)(get_group_id(1) * get_num_groups(0) + get_group_id(0));
        tile_best[2 * (index * tiles + tile)] = local_best[0];
        tile_best[2 * (index * tiles + tile) + 1] = local_at[0];
    }
}
#endif

// ---- both families ------------------------------------------------------------------------------------------

__kernel void __attribute__((reqd_work_group_size(BEST_ITEMS, 1, 1)))
ssd_search_best(
    __global const pixel *image,
    __global const int   *origins,
    __global const int   *scores,
    __global const int   *tile_best,
    __global int         *records,
    const int image_rows, const int image_columns,
    const int offset_rows, const int offset_columns,
    const int map_columns,
    const int tiles)
{
    const int index = (int)get_group_id(0);
    const int item = (int)get_local_id(0);

    int smallest = SCORE_NONE, smallest_at = SCORE_NONE;
    for (int tile = item; tile < tiles; tile += BEST_ITEMS) {
        const int score = tile_best[2 * (index * tiles + tile)];
        const int at = tile_best[2 * (index * tiles + tile) + 1];
        if (score < smallest || (score == smallest && at < smallest_at)) {
            smallest = score;
            smallest_at = at;
        }
    }
#if BEST_ITEMS > 1
    __local int local_best[BEST_ITEMS];
    __local int local_at[BEST_ITEMS];
    local_best[item] = smallest;
    local_at[item] = smallest_at;
    keep_smallest(local_best, local_at, item, BEST_ITEMS);
    barrier(CLK_LOCAL_MEM_FENCE);
    smallest_at = local_at[0];
#endif
    write_record(records + index * RECORD, image, origins + 2 * index, scores + index * offset_rows * map_columns,
                 smallest_at, image_rows, image_columns, offset_rows, offset_columns, map_columns, item, BEST_ITEMS);
}
