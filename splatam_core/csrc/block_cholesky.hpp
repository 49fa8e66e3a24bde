// Solves sparse symmetric positive definite systems of 6x6 blocks: those of a pose graph.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace splatam {

constexpr int kPoseSize = 6;

// The lower triangle of a symmetric matrix as blocks; of blocks at the same place the sum counts.
struct BlockMatrix {
  std::size_t size;           // blocks along a side
  std::size_t count;          // blocks given
  const std::int32_t* place;  // [count, 2] row and column of each, row >= column
  const double* blocks;       // [count, 6, 6]; of those on the diagonal only the lower triangle is read
};

// Writes the solution [size, 6] over the right-hand side; returns false if the matrix is not positive definite.
//
// Block Cholesky factorization. The pivots are taken in order of least degree (Tinney and Walker 1967), so that a chain
// with some loops fills in little.
bool solve_blocks(const BlockMatrix& matrix, double* right_hand_side);

}  // namespace splatam
