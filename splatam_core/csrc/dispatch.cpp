#include <cstdlib>
#include <cstring>

#include "kernels.hpp"

namespace splatam {

const Kernels& best_kernels() {
#if defined(__x86_64__)
  const char* wanted = std::getenv("SPLATAM_ISA");
  const bool any = wanted == nullptr || std::strcmp(wanted, "avx512") == 0;
  if (any && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw"))
    return kernels_avx512();
  if ((any || std::strcmp(wanted, "avx2") == 0) && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    return kernels_avx2();
#endif
  return kernels_generic();
}

}  // namespace splatam
