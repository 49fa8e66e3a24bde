#include "weigh.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace splatam {
namespace {

constexpr int kTwist = 6, kTimeOffset = 8;
constexpr double kUnknown = 3.0;  // m and rad, where nothing is known
constexpr double kMinCorrelation = 0.5, kMinContrast = 0.02, kMaxDifference = 0.1, kMinFilled = 0.25;
constexpr double kLeastSingularValue = 1e-15;  // relative to the largest one, as numpy.linalg.pinv
constexpr double kRounding = 1e-16;
constexpr int kMaxSweeps = 60;  // of Jacobi's method, which needs less than ten

template <int rows, int columns = rows>
struct Matrix {
  double entries[rows][columns] = {};
  double* operator[](int row) { return entries[row]; }
  const double* operator[](int row) const { return entries[row]; }
};

template <int rows, int inner, int columns>
Matrix<rows, columns> operator*(const Matrix<rows, inner>& a, const Matrix<inner, columns>& b) {
  Matrix<rows, columns> product;
  for (int i = 0; i < rows; ++i)
    for (int j = 0; j < inner; ++j)
      for (int k = 0; k < columns; ++k) product[i][k] += a[i][j] * b[j][k];
  return product;
}

template <int rows, int columns>
Matrix<columns, rows> transposed(const Matrix<rows, columns>& a) {
  Matrix<columns, rows> result;
  for (int i = 0; i < rows; ++i)
    for (int k = 0; k < columns; ++k) result[k][i] = a[i][k];
  return result;
}

using Twist6 = Matrix<kTwist>;
using All = Matrix<kUnknowns>;

// Returns a matrix with the prior of the unknowns from `first` on.
All with_prior(const double (&given)[kUnknowns][kUnknowns], const Knowns& known, int first) {
  All result;
  for (int i = 0; i < kUnknowns; ++i) {
    std::copy_n(given[i], kUnknowns, result[i]);
    if (i >= first) result[i][i] += known.prior[i];
  }
  return result;
}

// Returns the symmetric part of a matrix that is left for the twist, the other unknowns solved for by elimination.
Twist6 marginal(const All& given, const Knowns& known) {
  All H;
  for (int i = 0; i < kUnknowns; ++i)
    for (int k = 0; k < kUnknowns; ++k) H[i][k] = 0.5 * (given[i][k] + given[k][i]);
  bool is_left[kUnknowns];
  std::copy_n(known.is_free, kUnknowns, is_left);
  for (;;) {
    int pivot = -1;
    for (int i = kTwist; i < kUnknowns; ++i)
      if (is_left[i] && (pivot < 0 || std::fabs(H[i][i]) > std::fabs(H[pivot][pivot]))) pivot = i;
    if (pivot < 0) break;
    if (H[pivot][pivot] == 0.0) throw Undetermined("Singular matrix");
    is_left[pivot] = false;
    for (int i = 0; i < kUnknowns; ++i)
      for (int k = 0; k < kUnknowns; ++k)
        if (i != pivot && k != pivot) H[i][k] -= H[i][pivot] * H[pivot][k] / H[pivot][pivot];
  }
  Twist6 result;
  for (int i = 0; i < kTwist; ++i) std::copy_n(H[i], kTwist, result[i]);
  return result;
}

// Returns the inverse of Cholesky's factor.
Twist6 inverse_root(Twist6 L) {
  Twist6 inverse;
  for (int i = 0; i < kTwist; ++i) {
    for (int k = 0; k <= i; ++k) {
      for (int j = 0; j < k; ++j) L[i][k] -= L[i][j] * L[k][j];
      if (i == k && !(L[i][i] > 0.0)) throw Undetermined("Matrix is not positive definite");  // also NaN
      L[i][k] = i == k ? std::sqrt(L[i][i]) : L[i][k] / L[k][k];
    }
    inverse[i][i] = 1.0 / L[i][i];
    for (int k = 0; k < i; ++k) {
      for (int j = k; j < i; ++j) inverse[i][k] -= L[i][j] * inverse[j][k];
      inverse[i][k] /= L[i][i];
    }
  }
  return inverse;
}

// The rotation of two axes by which Jacobi's methods remove a product of theirs, from the squares and the product.
struct Rotation {
  Rotation(double first, double second, double product) {
    const double zeta = (second - first) / (2.0 * product);
    const double tangent = std::copysign(1.0, zeta) / (std::fabs(zeta) + std::sqrt(1.0 + zeta * zeta));
    cosine = 1.0 / std::sqrt(1.0 + tangent * tangent), sine = cosine * tangent;
  }

  void turn(double& first, double& second) const {
    const double before = first;
    first = cosine * before - sine * second, second = sine * before + cosine * second;
  }

  double cosine, sine;
};

// Diagonalises a symmetric matrix in place (Jacobi 1846). Returns the eigenvectors as columns.
Twist6 diagonalize(Twist6& M) {
  Twist6 vectors;
  for (int i = 0; i < kTwist; ++i) vectors[i][i] = 1.0;
  for (int sweep = 0; sweep < kMaxSweeps; ++sweep) {
    double off = 0.0, on = 0.0;
    for (int p = 0; p < kTwist; ++p) {
      on += M[p][p] * M[p][p];
      for (int q = p + 1; q < kTwist; ++q) off += M[p][q] * M[p][q];
    }
    if (!(off > kRounding * kRounding * on)) break;
    for (int p = 0; p < kTwist; ++p)
      for (int q = p + 1; q < kTwist; ++q) {
        if (M[p][q] == 0.0) continue;
        const Rotation rotation(M[p][p], M[q][q], M[p][q]);
        for (int i = 0; i < kTwist; ++i) rotation.turn(M[i][p], M[i][q]);
        for (int i = 0; i < kTwist; ++i) rotation.turn(M[p][i], M[q][i]);
        for (int i = 0; i < kTwist; ++i) rotation.turn(vectors[i][p], vectors[i][q]);
      }
  }
  return vectors;
}

// Returns the pseudo-inverse of the part of a matrix that belongs to the free unknowns, 0 elsewhere, by singular values
// (one-sided Jacobi, Hestenes 1958).
All pseudo_inverse(All U, const Knowns& known) {
  All V;
  for (int i = 0; i < kUnknowns; ++i) {
    V[i][i] = known.is_free[i];
    for (int k = 0; k < kUnknowns; ++k) U[i][k] = known.is_free[i] && known.is_free[k] ? U[i][k] : 0.0;
  }
  bool is_turned = true;
  for (int sweep = 0; sweep < kMaxSweeps && std::exchange(is_turned, false); ++sweep)
    for (int p = 0; p < kUnknowns; ++p)
      for (int q = p + 1; q < kUnknowns; ++q) {
        double first = 0.0, second = 0.0, product = 0.0;
        for (int i = 0; i < kUnknowns; ++i)
          first += U[i][p] * U[i][p], second += U[i][q] * U[i][q], product += U[i][p] * U[i][q];
        if (!(std::fabs(product) > 10.0 * kRounding * std::sqrt(first) * std::sqrt(second))) continue;
        is_turned = true;
        const Rotation rotation(first, second, product);
        for (int i = 0; i < kUnknowns; ++i) rotation.turn(U[i][p], U[i][q]), rotation.turn(V[i][p], V[i][q]);
      }
  double squares[kUnknowns] = {}, largest = 0.0;
  for (int k = 0; k < kUnknowns; ++k) {
    for (int i = 0; i < kUnknowns; ++i) squares[k] += U[i][k] * U[i][k];
    largest = std::max(largest, squares[k]);
  }
  All result;
  for (int k = 0; k < kUnknowns; ++k)
    if (std::sqrt(squares[k]) > kLeastSingularValue * std::sqrt(largest))
      for (int i = 0; i < kUnknowns; ++i)
        for (int j = 0; j < kUnknowns; ++j) result[i][j] += V[i][k] * U[j][k] / squares[k];
  return result;
}

// Returns how much the gradients of the cost scatter from cell to cell; cells that touch are taken together.
All scatter_of(const double (&scores)[kUnknowns][kCells], const Knowns& known) {
  constexpr int kBlockRows = kCellRows + 1, kBlockColumns = kCellColumns + 1;
  int num_cells = 0;
  double blocks[kUnknowns][kBlockRows][kBlockColumns] = {};
  for (int cell = 0; cell < kCells; ++cell) {
    const int row = cell / kCellColumns, column = cell % kCellColumns;
    bool is_empty = true;
    for (int i = 0; i < kUnknowns; ++i) {
      is_empty &= scores[i][cell] == 0.0;
      for (int block = 0; block < 4; ++block) blocks[i][row + block / 2][column + block % 2] += scores[i][cell];
    }
    num_cells += !is_empty;
  }
  const double factor = num_cells / std::max(num_cells - double(kTwist), 0.5) / 4.0;  // a twist fits six cells exactly
  All scatter;
  for (int i = 0; i < kUnknowns; ++i)
    for (int k = i; k < kUnknowns; ++k) {
      double sum = 0.0;
      for (int row = 0; row < kBlockRows; ++row)
        for (int column = 0; column < kBlockColumns; ++column) sum += blocks[i][row][column] * blocks[k][row][column];
      scatter[i][k] = scatter[k][i] = factor * sum;
    }
  for (int i = kTwist; i < kUnknowns; ++i)
    scatter[i][i] += known.prior[i] * (i == kTimeOffset ? known.prior_inflation : 1.0);
  return scatter;
}

// Returns the covariance of the twist at the colour image's time.
Twist6 clustered(const Aligner::Evidence& sums, const Knowns& known) {
  const All inverse = pseudo_inverse(with_prior(sums.shared, known, 0), known);
  Matrix<kTwist, kUnknowns> to_color;
  for (int i = 0; i < kTwist; ++i) to_color[i][i] = 1.0, to_color[i][kTimeOffset] = known.velocity[i];
  const Matrix<kTwist, kUnknowns> carried = to_color * inverse;
  return carried * scatter_of(sums.scores, known) * transposed(carried);
}

// Counts the cells that see enough of the map to be judged, and those of them that fit in brightness and depth.
std::pair<int, int> judged_and_fitting(const double (&sums)[kCellSums][kCells], const Knowns& known) {
  const auto compared = [&](int side) { return (side - known.step / 2 + known.step - 1) / known.step; };
  const auto share = [](int total, int parts, int part) {  // those of which part = index * parts / total
    return ((part + 1) * total + parts - 1) / parts - (part * total + parts - 1) / parts;
  };
  int judged = 0, fitting = 0;
  for (int cell = 0; cell < kCells; ++cell) {
    const double enough = kMinFilled * share(compared(known.height), kCellRows, cell / kCellColumns) *
                          share(compared(known.width), kCellColumns, cell % kCellColumns);
    double of_cell[kCellSums];
    for (int i = 0; i < kCellSums; ++i) of_cell[i] = sums[i][cell];
    const auto [lit, met, near, expected, found, expected_squared, found_squared, product, difference] = of_cell;
    if (!(enough > 0.0 && std::max(lit, met) >= enough)) continue;
    ++judged;
    const double count = std::max(lit, 1.0), mean = expected / count, mean_found = found / count;
    const double spread = expected_squared / count - mean * mean;
    const double spread_found = found_squared / count - mean_found * mean_found;
    const double correlation =
        (product / count - mean * mean_found) / std::sqrt(std::max(spread * spread_found, 1e-12));
    const bool is_alike =
        spread > kMinContrast * kMinContrast ? correlation > kMinCorrelation : difference / count < kMaxDifference;
    fitting += is_alike && (met < enough || 2.0 * near >= met);
  }
  return {judged, fitting};
}

}  // namespace

PoseWeight weigh(const Aligner::Evidence& sums, const Knowns& known) {
  for (int i = 0; i < kUnknowns; ++i)
    for (int k = 0; k < kUnknowns; ++k)
      if (!std::isfinite(sums.claimed[i][k]) || !std::isfinite(sums.shared[i][k]))
        throw Undetermined("the normal equations are not finite");
  double num_lit = 0.0;
  for (const double lit : sums.cells[0]) num_lit += lit;
  const double by_chance = 1.0 / std::sqrt(std::max(1.0, num_lit));
  const Twist6 claimed = marginal(with_prior(sums.claimed, known, 0), known);
  const Twist6 root = inverse_root(claimed);
  Twist6 fractions = root * marginal(with_prior(sums.shared, known, kTwist), known) * transposed(root);
  const Twist6 directions = transposed(root) * diagonalize(fractions);

  // The directions of whose information the images share less than they do by chance are left open.
  PoseWeight weight{};
  Twist6 open;
  for (int direction = 0; direction < kTwist; ++direction) {
    if (!(fractions[direction][direction] < by_chance)) continue;
    ++weight.num_open;
    for (int i = 0; i < kTwist; ++i)
      for (int k = 0; k < kTwist; ++k) open[i][k] += directions[i][direction] * directions[k][direction];
  }
  const Twist6 left_open = open * claimed;
  Twist6 determined;
  for (int i = 0; i < kTwist; ++i)
    for (int k = 0; k < kTwist; ++k) determined[i][k] = (i == k) - left_open[i][k];
  const Twist6 known_part = determined * clustered(sums, known) * transposed(determined);
  const Twist6 open_part = left_open * transposed(left_open);
  for (int i = 0; i < kTwist; ++i)
    for (int k = 0; k < kTwist; ++k) weight.covariance[i][k] = known_part[i][k] + kUnknown * kUnknown * open_part[i][k];
  const auto [judged, fitting] = judged_and_fitting(sums.cells, known);
  weight.explained = fitting / std::max(1.0, double(judged)), weight.num_explained = fitting;
  return weight;
}

}  // namespace splatam
