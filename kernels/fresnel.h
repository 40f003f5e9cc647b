// fresnel.h : the scaled tail of the Fresnel integral, for every argument from 0 to infinity, one in each lane.
//
//   A(z) = exp(-i pi z^2/2) int_z^inf exp(i pi t^2/2) dt = g(z) + i f(z)      docs/maths.md, eq. O5; DLMF 7.2
//
// B = (z + a) A(z) is smooth in t = (a - z)/(a + z) on [-1, 1]. It is fitted there by quotients of polynomials
// with one denominator for both parts, in 70-digit arithmetic, by least squares that were weighted until the
// largest error was smallest: 1.1e-8 of the degree-8 fit (float), 3.4e-16 of the degree-16 fit (double).

#ifndef ADOF_FRESNEL_H
#define ADOF_FRESNEL_H

#include "lanes.h"

// Re B/4, Im B/4 and their denominator: coefficients of t^0, t^1 ..
#if REAL_IS_DOUBLE
#define FRESNEL_SCALE REAL_C(1.75)   // a
#define FRESNEL_TERMS 17
static __constant real fresnel_fit[FRESNEL_TERMS][3] = {
    {REAL_C(0.000745997929714441172), REAL_C(0.00785232498031180377), REAL_C(0.0506244446356628034)},
    {REAL_C(0.00435549661215096246), REAL_C(0.0187184668027001026), REAL_C(0.0787580436245710884)},
    {REAL_C(0.0148100023322652994), REAL_C(0.0547892579576066895), REAL_C(0.270576485401936546)},
    {REAL_C(0.0347818097273203138), REAL_C(0.0727609697568207014), REAL_C(0.235446168476075348)},
    {REAL_C(0.0613173524446769337), REAL_C(0.111263576145828464), REAL_C(0.4907992677526308)},
    {REAL_C(0.0841940117028695999), REAL_C(0.0858354997705453947), REAL_C(0.223840111898904682)},
    {REAL_C(0.09108604149847869), REAL_C(0.0826809913954011075), REAL_C(0.435697011786638923)},
    {REAL_C(0.0780265472179161192), REAL_C(0.0259714377071858105), REAL_C(0.0586680688179170034)},
    {REAL_C(0.0522203118776008833), REAL_C(0.0165815845120442912), REAL_C(0.223276224983432477)},
    {REAL_C(0.0266675356337512343), REAL_C(-0.00853038692124460902), REAL_C(-0.0252158120591372439)},
    {REAL_C(0.00990846574949418781), REAL_C(-0.00252514285381200721), REAL_C(0.0694987410038231958)},
    {REAL_C(0.00233708929202814306), REAL_C(-0.00398308509983095184), REAL_C(-0.0161969494242039242)},
    {REAL_C(0.000231111960188384837), REAL_C(-0.000552944778788879171), REAL_C(0.0116049917639296131)},
    {REAL_C(-0.0000604280829076870257), REAL_C(-0.000261439126705745391), REAL_C(-0.00242493385528186177)},
    {REAL_C(-0.0000192004097835599458), REAL_C(-9.29914295483763159e-7), REAL_C(0.000717363733934564202)},
    {REAL_C(-1.96059088744455032e-6), REAL_C(-9.71502032358165477e-8), REAL_C(-0.0000742334228850852779)},
    {REAL_C(1.81296060180766634e-8), REAL_C(1.19840919224979435e-7), REAL_C(5.93299397108341402e-6)}
};
#else
#define FRESNEL_SCALE REAL_C(1.5)   // a
#define FRESNEL_TERMS 9
static __constant real fresnel_fit[FRESNEL_TERMS][3] = {
    {REAL_C(0.002217231976), REAL_C(0.01803396819), REAL_C(0.1182060587)},
    {REAL_C(0.008270167565), REAL_C(0.009024946152), REAL_C(-0.02809625614)},
    {REAL_C(0.01682103323), REAL_C(0.04213795295), REAL_C(0.2847844171)},
    {REAL_C(0.02246101959), REAL_C(0.001798432009), REAL_C(-0.1297795029)},
    {REAL_C(0.01910031432), REAL_C(0.02057659102), REAL_C(0.2432271357)},
    {REAL_C(0.01040553129), REAL_C(-0.007926117061), REAL_C(-0.1048959178)},
    {REAL_C(0.003316056917), REAL_C(0.0005648884404), REAL_C(0.07128934849)},
    {REAL_C(0.0002847048292), REAL_C(-0.001264574575), REAL_C(-0.01631406361)},
    {REAL_C(-3.321137236e-5), REAL_C(-0.000103240453), REAL_C(0.003407299529)}
};
#endif

// scale B(t)/4 at two t in [-1, 1]: side by side, neither waits for itself.
ALWAYS_INLINE void fresnel_tails(
    const vec t, const vec scale, cvec *tail, const vec other_t, const vec other_scale, cvec *other)
{
    const int last = FRESNEL_TERMS - 1;
    vec re = fresnel_fit[last][0], im = fresnel_fit[last][1], below = fresnel_fit[last][2];
    vec other_re = re, other_im = im, other_below = below;
    _Pragma("unroll")
    for (int i = last - 1; i >= 0; --i) {
        below = below * t + fresnel_fit[i][2];
        other_below = other_below * other_t + fresnel_fit[i][2];
        re = re * t + fresnel_fit[i][0];
        other_re = other_re * other_t + fresnel_fit[i][0];
        im = im * t + fresnel_fit[i][1];
        other_im = other_im * other_t + fresnel_fit[i][1];
    }
    const vec factor = scale / below, other_factor = other_scale / other_below;
    tail->re = factor * re;
    tail->im = factor * im;
    other->re = other_factor * other_re;
    other->im = other_factor * other_im;
}

#endif
