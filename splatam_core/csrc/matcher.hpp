// Matches the descriptors of two images.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatam {

constexpr std::size_t kDescriptor = 32;  // bytes

// Writes for each of n descriptors which of m others is its nearest and has it as its own nearest, by differing bits;
// -1 where there is none. Of equally near ones the first counts. distances: the bits, where there is one.
void match(const std::uint8_t* ours, std::size_t n, const std::uint8_t* others, std::size_t m, std::int32_t* partners,
           std::int32_t* distances);

}  // namespace splatam
