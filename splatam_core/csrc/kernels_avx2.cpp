#if defined(__x86_64__)
#include "kernels.hpp"

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma")
#endif
namespace splatam {
namespace avx2 {
#define SPLATAM_PAIRED 0
#include "lanes_32.inl"
#include "lanes.inl"
#include "projection.inl"
#include "align.inl"
#include "kernels.inl"
}  // namespace avx2
}  // namespace splatam
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

namespace splatam {
const Kernels& kernels_avx2() {
  static const Kernels kernels = avx2::table("avx2");
  return kernels;
}
}  // namespace splatam
#endif
