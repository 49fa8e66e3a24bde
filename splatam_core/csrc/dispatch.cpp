#include <cstdlib>
#include <stdexcept>
#include <string>

#include "kernels.hpp"

namespace splatam {
namespace {

enum InstructionSet { kGeneric, kAvx2, kAvx512 };

// Returns the best instruction set that SPLATAM_ISA allows.
InstructionSet allowed() {
  const char* wanted = std::getenv("SPLATAM_ISA");
  const std::string name = wanted == nullptr || *wanted == '\0' ? "avx512" : wanted;
  if (name == "avx512") return kAvx512;
  if (name == "avx2") return kAvx2;
  if (name == "generic") return kGeneric;
  throw std::invalid_argument("SPLATAM_ISA is '" + name + "'; expected generic, avx2 or avx512, or unset it");
}

}  // namespace

const Kernels& best_kernels() {
  [[maybe_unused]] const InstructionSet limit = allowed();
#if defined(__x86_64__)
  if (limit >= kAvx512 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw"))
    return kernels_avx512();
  if (limit >= kAvx2 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return kernels_avx2();
#endif
  return kernels_generic();
}

}  // namespace splatam
