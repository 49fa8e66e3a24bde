#include "matcher.hpp"

#include <array>
#include <cstring>
#include <limits>
#include <vector>

namespace splatam {
namespace {

using Words = std::array<std::uint64_t, kDescriptor / sizeof(std::uint64_t)>;

struct Nearest {
  std::int32_t distance = std::numeric_limits<std::int32_t>::max(), index = -1;
};

inline Words words_of(const std::uint8_t* descriptor) {
  Words words;
  std::memcpy(words.data(), descriptor, kDescriptor);
  return words;
}

// Inlined into each of its callers, so that it is compiled for the instructions that these may use.
[[gnu::always_inline]] inline void compare(const std::uint8_t* ours, std::size_t n, const std::vector<Words>& others,
                                           std::vector<Nearest>& to_ours, std::vector<Nearest>& to_others) {
  for (std::size_t i = 0; i < n; ++i) {
    const Words own = words_of(ours + i * kDescriptor);
    Nearest nearest;
    for (std::size_t k = 0; k < others.size(); ++k) {
      std::int32_t distance = 0;
      for (std::size_t word = 0; word < own.size(); ++word)
        distance += __builtin_popcountll(own[word] ^ others[k][word]);
      if (distance < nearest.distance) nearest = {distance, std::int32_t(k)};
      if (distance < to_others[k].distance) to_others[k] = {distance, std::int32_t(i)};
    }
    to_ours[i] = nearest;
  }
}

#if defined(__x86_64__)
[[gnu::target("popcnt")]] void compare_by_popcnt(const std::uint8_t* ours, std::size_t n,
                                                 const std::vector<Words>& others, std::vector<Nearest>& to_ours,
                                                 std::vector<Nearest>& to_others) {
  compare(ours, n, others, to_ours, to_others);
}
#endif

}  // namespace

void match(const std::uint8_t* ours, std::size_t n, const std::uint8_t* others, std::size_t m, std::int32_t* partners,
           std::int32_t* distances) {
  std::vector<Words> words(m);
  for (std::size_t k = 0; k < m; ++k) words[k] = words_of(others + k * kDescriptor);
  std::vector<Nearest> to_ours(n), to_others(m);
#if defined(__x86_64__)
  if (__builtin_cpu_supports("popcnt"))
    compare_by_popcnt(ours, n, words, to_ours, to_others);
  else
#endif
    compare(ours, n, words, to_ours, to_others);
  for (std::size_t i = 0; i < n; ++i) {
    const auto [distance, index] = to_ours[i];
    const bool is_mutual = index >= 0 && to_others[std::size_t(index)].index == std::int32_t(i);
    partners[i] = is_mutual ? index : -1;
    distances[i] = is_mutual ? distance : -1;
  }
}

}  // namespace splatam
