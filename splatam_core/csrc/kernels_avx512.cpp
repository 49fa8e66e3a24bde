#if defined(__x86_64__)
#include "kernels.hpp"

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma,avx512f,avx512vl,avx512dq,avx512bw"))), \
                             apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma,avx512f,avx512vl,avx512dq,avx512bw")
#endif
namespace splatam {
namespace avx512 {
#define SPLATAM_PAIRED 1
#include "lanes_32.inl"
#include "lanes.inl"
#include "projection.inl"
#include "align.inl"
#include "kernels.inl"
}  // namespace avx512
}  // namespace splatam
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

namespace splatam {
const Kernels& kernels_avx512() {
  static const Kernels kernels = avx512::table("avx512");
  return kernels;
}
}  // namespace splatam
#endif
