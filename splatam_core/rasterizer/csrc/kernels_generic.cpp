#include "kernels.hpp"

namespace splatam {
namespace generic {
#include "kernels.inl"
}
const Kernels& kernels_generic() {
  static const Kernels kernels{generic::project, generic::forward, generic::backward, "generic"};
  return kernels;
}
}  // namespace splatam
