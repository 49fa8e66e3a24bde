#if defined(__SSE2__)
#include <emmintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#include "kernels.hpp"

namespace splatam {
namespace generic {
#include "lanes_16.inl"
#include "lanes.inl"
#include "projection.inl"
#include "align.inl"
#include "kernels.inl"
}  // namespace generic
const Kernels& kernels_generic() {
  static const Kernels kernels = generic::table("generic");
  return kernels;
}
}  // namespace splatam
