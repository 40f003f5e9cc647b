// ssd_search.cl : find many templates in one image, each in its own window, in one launch.
//
//   score "ssd"          SSD(o) = sum_r (I(o + r) - T(r))^2                       docs/maths.md, eq. S2, S3
//   score "gain_offset"  R(o) = min over g >= 0, b of sum_r (g I(o + r) + b - T(r))^2 / sum_r (T(r) - mean T)^2
//                             = 1 - max(rho, 0)^2                                  docs/maths.md, eq. S5, S6
//   best(o)              the smallest score; of equals the first in row-major order
//
//   image       (image_rows, image_columns) pixel   uchar, ushort or float, as IMAGE_KIND says
//   templates   (count, PADDED_ROWS, TEMPLATE_COLUMNS) float   T less a constant, BLOCK_ROWS - 1 zero rows above and
//                                                      below. Constant: 128 (uchar); 0 (ssd) or mean T (gain_offset)
//   sums        (count, 2) int     uchar: sum T', sum T'^2 of the stored T'; else: bits of the float sum T'^2, unused
//   origins     (count, 2) int     row, column of each window's corner; the host keeps windows inside the image
//   scores      (count, offset_rows, offset_columns) int    ssd of uchar: the integer; else the bits of a float >= 0
//   tile_best   (count, tiles, 2) int                       a tile's smallest score and its row-major offset
//   records     (count, 11 + PATCH_ROWS * PATCH_COLUMNS) int   row, column of the best place in the image; the 3 x 3
//                                                      scores around it; the pixels around it as bits of floats
//   All scores are >= 0, so their bits order as integers do; NaN becomes infinity, and a score outside the map is
//   SCORE_NONE.
//
// Family "lanes" (LANES > 0): a work-item owns BLOCK_ROWS x (VECTORS * LANES) offsets in vector registers; no local
// memory, no barrier. Its window is copied once to private memory as float. On uchar each row of it meets BLOCK_ROWS
// template rows at once, one multiply-add a tap; the zero rows spare every test for the template's ends.
// Family "groups" (LANES == 0): a work-group of GROUP_COLUMNS x GROUP_ROWS items shares a window in local memory
// (TILE_ROWS + TEMPLATE_ROWS - 1) x (TILE_COLUMNS + TEMPLATE_COLUMNS - 1) pixels; an item owns ITEM_ROWS offsets
// below each other and holds their window values in registers; one barrier, then a tree for the smallest.
// ssd_search_best: one work-item (lanes) or one work-group (groups) a template.
//
// Error: uchar ssd exact. Float ssd below (TEMPLATE_ROWS + TEMPLATE_COLUMNS + 2) / 2 eps relative, for it sums row by
// row. gain_offset: uchar sums exact, then (8 + 4 TAPS/s) eps absolute, s the root of both centred sums of squares;
// else (2 (rows + columns) + 4 span + 12) eps absolute, span the window's range in standard deviations of the place.

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
#ifndef LANES
#define LANES 16              // 4, 8 or 16 floats a vector; 0 selects the groups family
#endif
#ifndef BLOCK_ROWS
#define BLOCK_ROWS 5          // lanes: offset rows of a work-item
#endif
#ifndef VECTORS
#define VECTORS 3             // lanes: vectors across; BLOCK_ROWS * VECTORS sums must fit the registers
#endif
#ifndef PATCH_MARGIN
#define PATCH_MARGIN 0        // pixels around the template in the record's patch; negative: no patch
#endif

#define PADDED_ROWS (TEMPLATE_ROWS + 2 * (BLOCK_ROWS - 1))
#define TAPS (TEMPLATE_ROWS * TEMPLATE_COLUMNS)
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
typedef uchar pixel;
#elif IMAGE_KIND == 1
typedef ushort pixel;
#else
typedef float pixel;
#endif

#if LANES > 0
#if LANES == 16
typedef float16 vec;
typedef int16 ivec;
typedef uchar16 ucharv;
typedef ushort16 ushortv;
#define LANE_INDEX ((ivec)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#elif LANES == 8
typedef float8 vec;
typedef int8 ivec;
typedef uchar8 ucharv;
typedef ushort8 ushortv;
#define LANE_INDEX ((ivec)(0, 1, 2, 3, 4, 5, 6, 7))
#else
typedef float4 vec;
typedef int4 ivec;
typedef uchar4 ucharv;
typedef ushort4 ushortv;
#define LANE_INDEX ((ivec)(0, 1, 2, 3))
#endif
typedef union { ivec all; int each[LANES]; } ivec_lanes;
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

// Pointer casts with a lowered alignment: vloadN and convert_* are real calls in PoCL.
typedef vec vec_any __attribute__((aligned(4)));
typedef ivec ivec_any __attribute__((aligned(4)));
typedef ucharv ucharv_any __attribute__((aligned(1)));
typedef ushortv ushortv_any __attribute__((aligned(2)));
#if IMAGE_KIND == 0
typedef ucharv_any pixels_any;
#elif IMAGE_KIND == 1
typedef ushortv_any pixels_any;
#else
typedef vec_any pixels_any;
#endif

#ifndef __has_builtin
#define __has_builtin(x) 0
#endif
#if __has_builtin(__builtin_convertvector)
#define TO_VEC(v) __builtin_convertvector(v, vec)
#define TO_IVEC(v) __builtin_convertvector(v, ivec)
#else
#define TO_VEC(v) JOIN(convert_float, LANES)(v)
#define TO_IVEC(v) JOIN(convert_int, LANES)(v)
#endif

typedef ivec integers;
typedef vec reals;
#define TO_INTEGERS(v) TO_IVEC(v)
#define TO_REALS(v) TO_VEC(v)
#define AS_INTEGERS(v) JOIN(as_int, LANES)(v)
#else
typedef int integers;
typedef float reals;
#define TO_INTEGERS(v) ((int)(v))
#define TO_REALS(v) ((float)(v))
#define AS_INTEGERS(v) as_int(v)
#endif

#if GAIN_OFFSET && IMAGE_KIND == 0
// Eq. S6: the sums are first moved, exactly, to about the footprint's own rounded mean, so that what is left to
// subtract is at most TAPS and float32 loses nothing.
static inline __attribute__((always_inline)) integers gain_offset_bits(
    const integers image_1, const integers image_2, const integers cross, const int template_1, const int template_2)
{
    const integers mean = TO_INTEGERS(TO_REALS(image_1) * (1.0f / TAPS));
    const integers rest = image_1 - mean * TAPS;
    const int template_mean = template_1 / TAPS;
    const int template_rest = template_1 - template_mean * TAPS;
    const reals image_variance = TO_REALS(image_2 - mean * (image_1 + rest))
                                 - TO_REALS(rest) * TO_REALS(rest) * (1.0f / TAPS);
    const float template_variance = (float)(template_2 - template_mean * (template_1 + template_rest))
                                    - (float)template_rest * (float)template_rest * (1.0f / TAPS);
    const reals covariance = TO_REALS(cross - mean * template_rest - image_1 * template_mean)
                             - TO_REALS(rest) * ((float)template_rest * (1.0f / TAPS));
    const reals residual = 1.0f - (covariance / image_variance) * (covariance / template_variance);
    const reals score = residual > 0.0f ? residual : (reals)0.0f;
    return AS_INTEGERS(((covariance > 0.0f) & (image_variance > 0.0f)) ? score : (reals)1.0f);
}
#endif

#if GAIN_OFFSET && IMAGE_KIND != 0
// A grey level of the window, so that means taken from it lose nothing; the same for all tiles of a window.
static inline float window_level(__global const pixel *image, __global const int *origin, const int image_columns,
                                 const int offset_rows, const int offset_columns)
{
    const int row = origin[0] + (offset_rows + TEMPLATE_ROWS - 1) / 2;
    const float middle = (float)image[row * image_columns + origin[1] + (offset_columns + TEMPLATE_COLUMNS - 1) / 2];
    return middle - middle == 0.0f ? middle : 0.0f;   // not NaN, not infinite
}
#endif

#if LANES > 0
// ---- lanes --------------------------------------------------------------------------------------------------

#define TILE_ROWS BLOCK_ROWS
#define TILE_COLUMNS (VECTORS * LANES)
#define WINDOW_ROWS (BLOCK_ROWS + TEMPLATE_ROWS - 1)
#define PITCH ((TILE_COLUMNS + TEMPLATE_COLUMNS - 1 + LANES - 1) / LANES * LANES)

#if IMAGE_KIND == 0
// A centred product is at most 2^14: float32 adds 1024 of them exactly, then they move to integers.
#define FLUSH_ROWS (1024 / TEMPLATE_COLUMNS)

// Sums over the template's footprint of `power` 1 or 2 of the window, exact in int: down the columns, then along.
static inline __attribute__((always_inline)) void window_sums(const float *window, const int row, const int power,
                                                              ivec *sums)
{
    int columns[PITCH] __attribute__((aligned(64)));
    #pragma unroll 1
    for (int x = 0; x < PITCH; x += LANES) {
        vec total = 0.0f;
        #pragma unroll 1
        for (int r = row; r < row + TEMPLATE_ROWS; ++r) {
            const vec value = *(const vec *)(window + r * PITCH + x);
            total += power == 2 ? value * value : value;
        }
        *(ivec *)(columns + x) = TO_IVEC(total);
    }
    #pragma unroll
    for (int j = 0; j < VECTORS; ++j) sums[j] = 0;
    #pragma unroll 1
    for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) sums[j] += *(const ivec_any *)(columns + c + j * LANES);
    }
}

// sum I'T' for every offset of the tile, exact.
static inline __attribute__((always_inline)) void correlate(const float *window, __global const float *padded,
                                                            ivec cross[BLOCK_ROWS][VECTORS])
{
    #pragma unroll
    for (int k = 0; k < BLOCK_ROWS; ++k)
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) cross[k][j] = 0;

    #pragma unroll 1
    for (int first = 0; first < WINDOW_ROWS; first += FLUSH_ROWS) {
        vec sum[BLOCK_ROWS][VECTORS];
        #pragma unroll
        for (int k = 0; k < BLOCK_ROWS; ++k)
            #pragma unroll
            for (int j = 0; j < VECTORS; ++j) sum[k][j] = 0.0f;

        const int last = first + FLUSH_ROWS < WINDOW_ROWS ? first + FLUSH_ROWS : WINDOW_ROWS;
        #pragma unroll 1
        for (int y = first; y < last; ++y) {
            const float *row = window + y * PITCH;
            __global const float *taps = padded + (y + BLOCK_ROWS - 1) * TEMPLATE_COLUMNS;
            #pragma unroll 1
            for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
                vec value[VECTORS];
                #pragma unroll
                for (int j = 0; j < VECTORS; ++j) value[j] = *(const vec_any *)(row + c + j * LANES);
                #pragma unroll
                for (int k = 0; k < BLOCK_ROWS; ++k) {
                    const float tap = taps[c - k * TEMPLATE_COLUMNS];
                    #pragma unroll
                    for (int j = 0; j < VECTORS; ++j) sum[k][j] += tap * value[j];
                }
            }
        }
        #pragma unroll
        for (int k = 0; k < BLOCK_ROWS; ++k)
            #pragma unroll
            for (int j = 0; j < VECTORS; ++j) cross[k][j] += TO_IVEC(sum[k][j]);
    }
}
#elif !GAIN_OFFSET
// Direct squared differences, summed along a row first and then down, which bounds the rounding error.
static inline __attribute__((always_inline)) void squared_differences(const float *window,
                                                                      __global const float *taps, vec *total)
{
    #pragma unroll
    for (int j = 0; j < VECTORS; ++j) total[j] = 0.0f;
    #pragma unroll 1
    for (int r = 0; r < TEMPLATE_ROWS; ++r) {
        vec along[VECTORS];
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) along[j] = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
            const float tap = taps[r * TEMPLATE_COLUMNS + c];
            #pragma unroll
            for (int j = 0; j < VECTORS; ++j) {
                const vec difference = *(const vec_any *)(window + r * PITCH + c + j * LANES) - tap;
                along[j] += difference * difference;
            }
        }
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) total[j] += along[j];
    }
}
#else
// Two passes, as the expanded form cancels on bright images: the mean of each footprint, then its centred sums.
static inline __attribute__((always_inline)) void centred_sums(const float *window, __global const float *taps,
                                                               vec *squares, vec *cross)
{
    vec mean[VECTORS];
    #pragma unroll
    for (int j = 0; j < VECTORS; ++j) mean[j] = squares[j] = cross[j] = 0.0f;
    #pragma unroll 1
    for (int r = 0; r < TEMPLATE_ROWS; ++r) {
        vec along[VECTORS];
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) along[j] = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < TEMPLATE_COLUMNS; ++c)
            #pragma unroll
            for (int j = 0; j < VECTORS; ++j)
                along[j] += *(const vec_any *)(window + r * PITCH + c + j * LANES);
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) mean[j] += along[j];
    }
    #pragma unroll
    for (int j = 0; j < VECTORS; ++j) mean[j] *= 1.0f / TAPS;

    #pragma unroll 1
    for (int r = 0; r < TEMPLATE_ROWS; ++r) {
        vec along[VECTORS], across[VECTORS];
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) along[j] = across[j] = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < TEMPLATE_COLUMNS; ++c) {
            const float tap = taps[r * TEMPLATE_COLUMNS + c];
            #pragma unroll
            for (int j = 0; j < VECTORS; ++j) {
                const vec value = *(const vec_any *)(window + r * PITCH + c + j * LANES) - mean[j];
                along[j] += value * value;
                across[j] += tap * value;
            }
        }
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) { squares[j] += along[j]; cross[j] += across[j]; }
    }
}
#endif

__kernel void __attribute__((reqd_work_group_size(1, 1, 1)))
ssd_search(
    __global const pixel *image,
    __global const float *templates,
    __global const int   *sums,
    __global const int   *origins,
    __global int         *scores,
    __global int         *tile_best,
    const int image_rows, const int image_columns,
    const int offset_rows, const int offset_columns)
{
    const int x0 = (int)get_global_id(0) * TILE_COLUMNS;
    const int y0 = (int)get_global_id(1) * TILE_ROWS;
    const int index = (int)get_global_id(2);

    const int rows = min(WINDOW_ROWS, offset_rows + TEMPLATE_ROWS - 1 - y0);
    const int columns = min((int)(TILE_COLUMNS + TEMPLATE_COLUMNS - 1), offset_columns + TEMPLATE_COLUMNS - 1 - x0);
    __global const pixel *corner = image + (origins[2 * index] + y0) * image_columns + origins[2 * index + 1] + x0;
#if IMAGE_KIND == 0
    const float level = 128.0f;
#elif GAIN_OFFSET
    const float level = window_level(image, origins + 2 * index, image_columns, offset_rows, offset_columns);
#else
    const float level = 0.0f;
#endif

    float window[WINDOW_ROWS * PITCH] __attribute__((aligned(64)));
    #pragma unroll 1
    for (int y = 0; y < WINDOW_ROWS; ++y) {
        __global const pixel *from = corner + y * image_columns;
        float *to = window + y * PITCH;
        const int have = y < rows ? columns : 0;
        int x = 0;
        #pragma unroll 1
        for (; x + LANES <= have; x += LANES)
            *(vec *)(to + x) = TO_VEC(*(__global const pixels_any *)(from + x)) - level;
        #pragma unroll 1
        for (; x < have; ++x) to[x] = (float)from[x] - level;
        #pragma unroll 1
        for (; x < PITCH; ++x) to[x] = 0.0f;
    }

    __global const float *padded = templates + index * (PADDED_ROWS * TEMPLATE_COLUMNS);
#if IMAGE_KIND == 0
    ivec cross[BLOCK_ROWS][VECTORS];
    correlate(window, padded, cross);
#else
    __global const float *taps = padded + (BLOCK_ROWS - 1) * TEMPLATE_COLUMNS;
#endif

    ivec best = SCORE_NONE, best_at = 0;
    const int valid_rows = min(TILE_ROWS, offset_rows - y0);
    #pragma unroll 1
    for (int k = 0; k < valid_rows; ++k) {
        ivec score[VECTORS];
#if IMAGE_KIND == 0
        ivec squares[VECTORS];
        window_sums(window, k, 2, squares);
#if GAIN_OFFSET
        ivec means[VECTORS];
        window_sums(window, k, 1, means);
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j)
            score[j] = gain_offset_bits(means[j], squares[j], cross[k][j], sums[2 * index], sums[2 * index + 1]);
#else
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) score[j] = squares[j] + sums[2 * index + 1] - 2 * cross[k][j];
#endif
#else
        vec value[VECTORS];
#if GAIN_OFFSET
        vec squares[VECTORS], product[VECTORS];
        centred_sums(window + k * PITCH, taps, squares, product);
        const float template_squares = as_float(sums[2 * index]);
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) {
            const vec residual = 1.0f - (product[j] / squares[j]) * (product[j] / template_squares);
            value[j] = product[j] > 0.0f ? (residual > 0.0f ? residual : (vec)0.0f) : (vec)1.0f;
            // A footprint that holds NaN or infinity matches nothing.
            value[j] = squares[j] < INFINITY ? value[j] : (vec)INFINITY;
        }
#else
        squared_differences(window + k * PITCH, taps, value);
#endif
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) {
            value[j] = value[j] >= 0.0f ? value[j] : (vec)INFINITY;
            score[j] = AS_INTEGERS(value[j]);
        }
#endif
        __global int *to = scores + (index * offset_rows + y0 + k) * offset_columns + x0;
        #pragma unroll
        for (int j = 0; j < VECTORS; ++j) {
            const ivec at = LANE_INDEX + j * LANES;
            const ivec outside = at >= offset_columns - x0;
            const ivec place = at + ((y0 + k) * offset_columns + x0);
            if (j * LANES + LANES <= offset_columns - x0) {
                *(__global ivec_any *)(to + j * LANES) = score[j];
            } else {
                ivec_lanes out;
                out.all = score[j];
                #pragma unroll 1
                for (int i = 0; i < offset_columns - x0 - j * LANES; ++i) to[j * LANES + i] = out.each[i];
            }
            const ivec checked = outside ? (ivec)SCORE_NONE : score[j];
            const ivec better = checked < best;
            best_at = better ? place : best_at;
            best = better ? checked : best;
        }
    }

    ivec_lanes value, place;
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
    tile_best[2 * (index * tiles + tile)] = smallest;
    tile_best[2 * (index * tiles + tile) + 1] = smallest_at;
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

#if IMAGE_KIND == 0
typedef int number;           // exact
#else
typedef float number;
#endif

__kernel void __attribute__((reqd_work_group_size(GROUP_COLUMNS, GROUP_ROWS, 1)))
ssd_search(
    __global const pixel *image,
    __global const float *templates,
    __global const int   *sums,
    __global const int   *origins,
    __global int         *scores,
    __global int         *tile_best,
    const int image_rows, const int image_columns,
    const int offset_rows, const int offset_columns)
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

#if IMAGE_KIND == 0
    const number level = 128;
#elif GAIN_OFFSET
    const number level = window_level(image, origins + 2 * index, image_columns, offset_rows, offset_columns);
#else
    const number level = 0.0f;
#endif

    const int column = (int)get_local_id(0);
    const int row = (int)get_local_id(1) * ITEM_ROWS;
    __global const float *taps = templates + (index * PADDED_ROWS + BLOCK_ROWS - 1) * TEMPLATE_COLUMNS;
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
#else
#if GAIN_OFFSET
        const float residual = 1.0f - (cross[k] / squares[k]) * (cross[k] / as_float(sums[2 * index]));
        float value = cross[k] > 0.0f ? (residual > 0.0f ? residual : 0.0f) : 1.0f;
        value = squares[k] < INFINITY ? value : INFINITY;
#else
        const float value = squares[k];
#endif
        const int score = as_int(value >= 0.0f ? value : INFINITY);
#endif
        scores[(index * offset_rows + y) * offset_columns + x] = score;
        if (score < smallest) {
            smallest = score;
            smallest_at = y * offset_columns + x;
        }
    }

    local_best[item] = smallest;
    local_at[item] = smallest_at;
    for (int half_items = GROUP_ITEMS / 2; half_items > 0; half_items /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < half_items) {
            const int other = local_best[item + half_items];
            const int other_at = local_at[item + half_items];
            if (other < local_best[item] || (other == local_best[item] && other_at < local_at[item])) {
                local_best[item] = other;
                local_at[item] = other_at;
            }
        }
    }
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
    for (int half_items = BEST_ITEMS / 2; half_items > 0; half_items /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < half_items) {
            const int other = local_best[item + half_items];
            const int other_at = local_at[item + half_items];
            if (other < local_best[item] || (other == local_best[item] && other_at < local_at[item])) {
                local_best[item] = other;
                local_at[item] = other_at;
            }
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    smallest_at = local_at[0];
#endif

    const int y = smallest_at / offset_columns;
    const int x = smallest_at - y * offset_columns;
    const int top = origins[2 * index] + y;
    const int left = origins[2 * index + 1] + x;
    __global int *record = records + index * RECORD;
    if (item == 0) {
        record[0] = top;
        record[1] = left;
        for (int ny = y - 1; ny <= y + 1; ++ny) {
            for (int nx = x - 1; nx <= x + 1; ++nx) {
                const int inside = ny >= 0 && ny < offset_rows && nx >= 0 && nx < offset_columns;
                record[2 + 3 * (ny - y + 1) + nx - x + 1] =
                    inside ? scores[(index * offset_rows + ny) * offset_columns + nx] : SCORE_NONE;
            }
        }
    }
#if PATCH_ROWS > 0
    // Beyond the image's edge the patch repeats the last pixel.
    for (int r = 0; r < PATCH_ROWS; ++r) {
        __global const pixel *from = image + clamp(top - PATCH_MARGIN + r, 0, image_rows - 1) * image_columns;
        for (int c = item; c < PATCH_COLUMNS; c += BEST_ITEMS)
            record[11 + r * PATCH_COLUMNS + c] = as_int((float)from[clamp(left - PATCH_MARGIN + c, 0, image_columns - 1)]);
    }
#endif
}
