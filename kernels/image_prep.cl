// image_prep.cl : correct a camera's raw integers and crop the region of interest.
//
//   image = gain (frame - dark)                       docs/maths.md, eq. S1
//
//   frame    (frame_rows, frame_columns) uchar or ushort   raw grey levels, as FRAME_KIND says
//   dark     (rows, columns) or (1,) float   grey levels; of the region alone; one value unless PER_PIXEL
//   gain     (rows, columns) or (1,) float   output levels per grey level; likewise
//   image    (rows, columns) float or uchar  uchar, if TO_BYTES: floor(x + 1/2), held to 0 .. 255
//   top, left                                corner of the region in the frame; the host keeps it inside
//   run      > 0                             pixels a work-item owns, side by side
//
// One work-item per run of pixels in a row (a whole row on CPUs, where the loop becomes vectors; one pixel
// elsewhere); no local memory, no barriers.
// Error: float below 2 eps gain (frame + |dark|); uchar exact but where x + 1/2 is whole to rounding.

#ifndef FRAME_KIND
#define FRAME_KIND 0          // 0 uchar, 1 ushort
#endif
#ifndef PER_PIXEL
#define PER_PIXEL 0           // 1: dark and gain are maps
#endif
#ifndef TO_BYTES
#define TO_BYTES 0            // 1: uchar out
#endif

#if FRAME_KIND == 0
typedef uchar raw;
#else
typedef ushort raw;
#endif
#if TO_BYTES
typedef uchar corrected;
#else
typedef float corrected;
#endif

__kernel void image_prep(
    __global const raw   *restrict frame,
    __global const float *restrict dark,
    __global const float *restrict gain,
    __global corrected   *restrict image,
    const int frame_columns, const int top, const int left,
    const int rows, const int columns, const int run)
{
    const int row = (int)get_global_id(1);
    const int first = (int)get_global_id(0) * run;
    if (row >= rows || first >= columns) return;

    const int last = min(first + run, columns);
    __global const raw *from = frame + (top + row) * frame_columns + left;
    __global corrected *to = image + row * columns;
    for (int x = first; x < last; ++x) {
#if PER_PIXEL
        const int at = row * columns + x;
#else
        const int at = 0;
#endif
        const float value = gain[at] * ((float)from[x] - dark[at]);
#if TO_BYTES
        const float rounded = value + 0.5f;
        to[x] = (uchar)(int)(rounded > 0.0f ? (rounded < 255.0f ? rounded : 255.0f) : 0.0f);
#else
        to[x] = value;
#endif
    }
}
