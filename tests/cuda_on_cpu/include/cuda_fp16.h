// Half precision by the processor's conversions (F16C).
#pragma once

#include <cuda_runtime.h>
#include <immintrin.h>

struct __half {
  uint16_t bits;
};
struct alignas(4) __half2 {
  __half x, y;
};
inline __half __float2half_rn(float f) { return {uint16_t(_cvtss_sh(f, 0))}; }
inline float __half2float(__half h) { return _cvtsh_ss(h.bits); }
inline uint16_t __half_as_ushort(__half h) { return h.bits; }
inline __half2 __floats2half2_rn(float a, float b) { return {__float2half_rn(a), __float2half_rn(b)}; }
inline __half2 __float2half2_rn(float a) { return __floats2half2_rn(a, a); }
inline float __low2float(__half2 h) { return __half2float(h.x); }
inline float __high2float(__half2 h) { return __half2float(h.y); }
inline __half2 __hsub2(__half2 a, __half2 b) {
  return __floats2half2_rn(__low2float(a) - __low2float(b), __high2float(a) - __high2float(b));
}
inline __half2 __hadd2(__half2 a, __half2 b) {
  return __floats2half2_rn(__low2float(a) + __low2float(b), __high2float(a) + __high2float(b));
}
inline __half2 __hmin2(__half2 a, __half2 b) {
  return __floats2half2_rn(fminf(__low2float(a), __low2float(b)), fminf(__high2float(a), __high2float(b)));
}
inline __half2 __hmax2(__half2 a, __half2 b) {
  return __floats2half2_rn(fmaxf(__low2float(a), __low2float(b)), fmaxf(__high2float(a), __high2float(b)));
}
inline __half2 __hfma2(__half2 a, __half2 b, __half2 c) {
  return __floats2half2_rn(fmaf(__low2float(a), __low2float(b), __low2float(c)),
                           fmaf(__high2float(a), __high2float(b), __high2float(c)));
}
inline __half2 __hfma2_relu(__half2 a, __half2 b, __half2 c) {
  const __half2 sum = __hfma2(a, b, c);
  auto or_zero = [](__half h) { return __half2float(h) < 0 ? __half{0} : h; };
  return {or_zero(sum.x), or_zero(sum.y)};
}
inline __half2 __hfma2_sat(__half2 a, __half2 b, __half2 c) {
  const __half2 sum = __hfma2(a, b, c);
  return __floats2half2_rn(fminf(fmaxf(__low2float(sum), 0), 1), fminf(fmaxf(__high2float(sum), 0), 1));
}
inline __half2 __hmul2(__half2 a, __half2 b) {
  return __floats2half2_rn(__low2float(a) * __low2float(b), __high2float(a) * __high2float(b));
}
inline __half2 __hneg2(__half2 a) {
  a.x.bits ^= 0x8000, a.y.bits ^= 0x8000;
  return a;
}
inline __half __hsub(__half a, __half b) { return __float2half_rn(__half2float(a) - __half2float(b)); }
inline __half __low2half(__half2 a) { return a.x; }
inline __half __high2half(__half2 a) { return a.y; }
inline __half2 __halves2half2(__half a, __half b) { return {a, b}; }
inline __half2 __lows2half2(__half2 a, __half2 b) { return {a.x, b.x}; }
inline __half2 __highs2half2(__half2 a, __half2 b) { return {a.y, b.y}; }
inline __half2 __low2half2(__half2 a) { return {a.x, a.x}; }
inline __half2 __high2half2(__half2 a) { return {a.y, a.y}; }
inline unsigned __hge2_mask(__half2 a, __half2 b) {
  return (__low2float(a) >= __low2float(b) ? 0xffffu : 0) | (__high2float(a) >= __high2float(b) ? 0xffff0000u : 0);
}

// ex2.approx.f16x2
inline unsigned exp2_halves(unsigned x) {
  __half2 h;
  memcpy(&h, &x, sizeof h);
  h = __floats2half2_rn(exp2f(__low2float(h)), exp2f(__high2float(h)));
  memcpy(&x, &h, sizeof x);
  return x;
}
