// precision.h : the only file that says float or double.
//
//   REAL_IS_DOUBLE   1: real is double (needs fp64); 0, the default: float

#ifndef ADOF_PRECISION_H
#define ADOF_PRECISION_H

#ifndef REAL_IS_DOUBLE
#define REAL_IS_DOUBLE 0
#endif

#if REAL_IS_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double  real;
typedef double2 real2;
#define REAL_C(x)   (x)
#define REAL_EPS    2.220446049250313e-16
#define REAL_LEAST  1e-200
#else
typedef float  real;
typedef float2 real2;
#define REAL_C(x)   (x##f)
#define REAL_EPS    1.1920929e-7f
#define REAL_LEAST  1e-26f   // least divisor of a filter: 2^40 over it (2^300 in double) is still finite
#endif

typedef real2 cplx;   // .x real part, .y imaginary part

#endif
