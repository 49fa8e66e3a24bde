#include "block_cholesky.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <set>

namespace splatam {
namespace {

constexpr int N = kPoseSize;
using Block = std::array<double, std::size_t(N) * N>;

// One column of the factor: the rows below the diagonal, as positions in the order of elimination, and their blocks.
struct Column {
  Block diagonal{};
  std::vector<std::uint32_t> rows;  // increasing
  std::vector<Block> blocks;

  Block& at(std::uint32_t row) {
    return blocks[std::size_t(std::lower_bound(rows.begin(), rows.end(), row) - rows.begin())];
  }
};

// Returns the position of each block row in the order of elimination, and fills in the rows of each column.
std::vector<std::uint32_t> eliminate(const BlockMatrix& matrix, std::vector<Column>& columns) {
  std::vector<std::vector<std::uint32_t>> neighbours(matrix.size);
  for (std::size_t k = 0; k < matrix.count; ++k) {
    const auto row = std::uint32_t(matrix.place[2 * k]), column = std::uint32_t(matrix.place[2 * k + 1]);
    if (row == column) continue;
    neighbours[row].push_back(column);
    neighbours[column].push_back(row);
  }
  std::set<std::pair<std::size_t, std::uint32_t>> by_degree;
  for (std::uint32_t node = 0; node < matrix.size; ++node) {
    auto& mine = neighbours[node];
    std::sort(mine.begin(), mine.end());
    mine.erase(std::unique(mine.begin(), mine.end()), mine.end());
    by_degree.emplace(mine.size(), node);
  }
  std::vector<std::uint32_t> position(matrix.size);
  std::vector<std::uint32_t> merged;
  for (std::uint32_t step = 0; step < matrix.size; ++step) {
    const std::uint32_t pivot = by_degree.begin()->second;
    by_degree.erase(by_degree.begin());
    position[pivot] = step;
    const auto& clique = neighbours[pivot];
    for (const std::uint32_t node : clique) {
      auto& mine = neighbours[node];
      by_degree.erase({mine.size(), node});
      merged.clear();
      std::set_union(mine.begin(), mine.end(), clique.begin(), clique.end(), std::back_inserter(merged));
      merged.erase(std::remove_if(merged.begin(), merged.end(), [&](auto n) { return n == node || n == pivot; }),
                   merged.end());
      mine = merged;
      by_degree.emplace(mine.size(), node);
    }
    columns[step].rows = clique;  // nodes; positions once all are known
  }
  for (Column& column : columns) {
    for (std::uint32_t& row : column.rows) row = position[row];
    std::sort(column.rows.begin(), column.rows.end());
    column.blocks.assign(column.rows.size(), Block{});
  }
  return position;
}

void add_given(const BlockMatrix& matrix, const std::vector<std::uint32_t>& position, std::vector<Column>& columns) {
  for (std::size_t k = 0; k < matrix.count; ++k) {
    const std::uint32_t row = position[std::size_t(matrix.place[2 * k])];
    const std::uint32_t column = position[std::size_t(matrix.place[2 * k + 1])];
    const double* block = matrix.blocks + k * N * N;
    Block& sum = row == column ? columns[row].diagonal : columns[std::min(row, column)].at(std::max(row, column));
    for (int r = 0; r < N; ++r)
      for (int c = 0; c < N; ++c) sum[std::size_t(N * r + c)] += row < column ? block[N * c + r] : block[N * r + c];
  }
}

// Replaces the lower triangle of A by L with L L' = A; false if A is not positive definite.
bool factorize(Block& A) {
  for (int c = 0; c < N; ++c) {
    double pivot = A[std::size_t(N * c + c)];
    for (int k = 0; k < c; ++k) pivot -= A[std::size_t(N * c + k)] * A[std::size_t(N * c + k)];
    if (!(pivot > 0) || !std::isfinite(pivot)) return false;
    const double root = A[std::size_t(N * c + c)] = std::sqrt(pivot);
    for (int r = c + 1; r < N; ++r) {
      double value = A[std::size_t(N * r + c)];
      for (int k = 0; k < c; ++k) value -= A[std::size_t(N * r + k)] * A[std::size_t(N * c + k)];
      A[std::size_t(N * r + c)] = value / root;
    }
  }
  return true;
}

// x := L^-1 x
void forward(const Block& L, double* x) {
  for (int r = 0; r < N; ++r) {
    for (int k = 0; k < r; ++k) x[r] -= L[std::size_t(N * r + k)] * x[k];
    x[r] /= L[std::size_t(N * r + r)];
  }
}

// x := L'^-1 x
void backward(const Block& L, double* x) {
  for (int r = N - 1; r >= 0; --r) {
    for (int k = r + 1; k < N; ++k) x[r] -= L[std::size_t(N * k + r)] * x[k];
    x[r] /= L[std::size_t(N * r + r)];
  }
}

Block transposed(const Block& A) {
  Block result;
  for (int r = 0; r < N; ++r)
    for (int c = 0; c < N; ++c) result[std::size_t(N * c + r)] = A[std::size_t(N * r + c)];
  return result;
}

// C -= A B
void subtract_product(Block& C, const Block& A, const Block& B) {
  for (int r = 0; r < N; ++r) {
    double* row = &C[std::size_t(N * r)];
    for (int k = 0; k < N; ++k) {
      const double factor = A[std::size_t(N * r + k)];
      const double* other = &B[std::size_t(N * k)];
      for (int c = 0; c < N; ++c) row[c] -= factor * other[c];
    }
  }
}

bool factorize(std::vector<Column>& columns) {
  for (Column& column : columns) {
    if (!factorize(column.diagonal)) return false;
    for (Block& block : column.blocks)
      for (int r = 0; r < N; ++r) forward(column.diagonal, &block[std::size_t(N * r)]);  // B := B L'^-1, row by row
    for (std::size_t i = 0; i < column.rows.size(); ++i) {
      Column& target = columns[column.rows[i]];
      const Block other = transposed(column.blocks[i]);
      subtract_product(target.diagonal, column.blocks[i], other);
      auto place = target.rows.begin();  // the rows of both increase
      for (std::size_t k = i + 1; k < column.rows.size(); ++k) {
        place = std::lower_bound(place, target.rows.end(), column.rows[k]);
        subtract_product(target.blocks[std::size_t(place - target.rows.begin())], column.blocks[k], other);
      }
    }
  }
  return true;
}

void substitute(const std::vector<Column>& columns, std::vector<double>& x) {
  for (std::size_t p = 0; p < columns.size(); ++p) {
    const Column& column = columns[p];
    forward(column.diagonal, &x[p * N]);
    for (std::size_t i = 0; i < column.rows.size(); ++i)
      for (int r = 0; r < N; ++r)
        for (int k = 0; k < N; ++k)
          x[column.rows[i] * N + std::size_t(r)] -=
              column.blocks[i][std::size_t(N * r + k)] * x[p * N + std::size_t(k)];
  }
  for (std::size_t p = columns.size(); p-- > 0;) {
    const Column& column = columns[p];
    for (std::size_t i = 0; i < column.rows.size(); ++i)
      for (int r = 0; r < N; ++r)
        for (int k = 0; k < N; ++k)
          x[p * N + std::size_t(k)] -=
              column.blocks[i][std::size_t(N * r + k)] * x[column.rows[i] * N + std::size_t(r)];
    backward(column.diagonal, &x[p * N]);
  }
}

}  // namespace

bool solve_blocks(const BlockMatrix& matrix, double* right_hand_side) {
  std::vector<Column> columns(matrix.size);
  const std::vector<std::uint32_t> position = eliminate(matrix, columns);
  add_given(matrix, position, columns);
  if (!factorize(columns)) return false;
  std::vector<double> x(matrix.size * N);
  for (std::size_t node = 0; node < matrix.size; ++node)
    std::copy_n(right_hand_side + node * N, N, x.begin() + std::ptrdiff_t(position[node] * N));
  substitute(columns, x);
  for (std::size_t node = 0; node < matrix.size; ++node)
    std::copy_n(x.begin() + std::ptrdiff_t(position[node] * N), N, right_hand_side + node * N);
  return true;
}

}  // namespace splatam
