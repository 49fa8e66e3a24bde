#include "kernels.hpp"

namespace splatam {
namespace generic {
#define SPLATAM_PAIRED 0
#include "lanes.inl"
#include "align.inl"
#include "kernels.inl"
}  // namespace generic
const Kernels& kernels_generic() {
  static const Kernels kernels = generic::table("generic");
  return kernels;
}
}  // namespace splatam
