#include "descent.hpp"

#include <algorithm>
#include <cmath>

namespace splatam {
namespace {

constexpr int kMinPoints = 50;
constexpr double kMinScales[2] = {0.004, 0.001};  // no sensor is better
constexpr double kMadToDeviation = 1.4826;        // standard deviation over median absolute deviation
constexpr int kReadout = kUnknowns;

// Writes the twist in one interval between frames, from the motion since the last pose: less of what is not possible.
void twist_of(const Pace& pace, const Motion& since_last, Twist& twist) {
  log(since_last, twist);
  double squared[2] = {};
  for (int i = 0; i < 6; ++i) {
    twist[i] /= pace.num_frames;
    const double off = twist[i] - pace.expected[i];
    squared[i / 3] += off * off;
  }
  const double excess = std::max(std::sqrt(squared[0]) / pace.limit_m, std::sqrt(squared[1]) / pace.limit_rad);
  if (excess <= 1) return;
  for (int i = 0; i < 6; ++i) twist[i] = pace.expected[i] + (twist[i] - pace.expected[i]) / (excess * excess);
}

Pose pose_of(const Motion& motion) {
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) pose.R[3 * row + column] = float(motion.R[row][column]);
    pose.t[row] = float(motion.t[row]);
  }
  return pose;
}

// Returns the images, linearised at a state.
Aligned at_state(const Descent& task, const AlignmentState& state) {
  Aligned at = task.images;
  at.color_motion = at.depth_motion = pose_of(state.depth_motion);
  if (state.time_offset != 0.0) {
    Twist moved;
    for (int i = 0; i < 6; ++i) moved[i] = state.time_offset * state.velocity[i];
    at.color_motion = pose_of(exp(moved) * state.depth_motion);
  }
  for (int i = 0; i < 6; ++i) {
    at.settings.velocity[i] = float(state.velocity[i]);
    at.readout[i] = float(state.readout * state.velocity[i]);
  }
  at.settings.gain = float(state.gain), at.settings.bias = float(state.bias);
  at.settings.photometric_scale = float(state.scales[0] * task.scale_factors[0]);
  at.settings.depth_scale = float(state.scales[1] * task.scale_factors[1]);
  return at;
}

// The entry of a symmetric matrix of which the upper triangle is stored row by row.
double entry(const double* triangle, int row, int column) {
  if (row > column) std::swap(row, column);
  return triangle[row * kUnknowns - row * (row - 1) / 2 + column - row];
}

// Normal equations of the unknowns that are free.
struct Equations {
  int count = 0;
  int unknowns[kAllUnknowns];
  double H[kAllUnknowns][kAllUnknowns], g[kAllUnknowns];
};

// A point moves with the readout as with the time offset, times when its row is read.
Equations equations_of(const Aligner::Result& system, const AlignmentState& state, const Descent& task) {
  double H[kAllUnknowns][kAllUnknowns] = {}, g[kAllUnknowns] = {};
  for (int row = 0; row < kUnknowns; ++row) {
    for (int column = 0; column < kUnknowns; ++column) H[row][column] = entry(system.sums.H, row, column);
    g[row] = system.sums.g[row];
    for (int i = 0; i < 6; ++i) H[row][kReadout] += entry(system.moments.H1, row, i) * state.velocity[i];
    H[kReadout][row] = H[row][kReadout];
  }
  for (int i = 0; i < 6; ++i) {
    g[kReadout] += state.velocity[i] * system.moments.g1[i];
    for (int k = 0; k < 6; ++k)
      H[kReadout][kReadout] += state.velocity[i] * entry(system.moments.H2, i, k) * state.velocity[k];
  }
  const double found[kAllUnknowns] = {0, 0, 0, 0, 0, 0, state.gain, state.bias, state.time_offset, state.readout};
  Equations free;
  for (int i = 0; i < kAllUnknowns; ++i) {
    H[i][i] += task.information[i];
    g[i] += task.information[i] * (found[i] - task.mean[i]);
    if (task.is_free[i]) free.unknowns[free.count++] = i;
  }
  for (int i = 0; i < free.count; ++i) {
    free.g[i] = g[free.unknowns[i]];
    for (int k = 0; k < free.count; ++k) free.H[i][k] = H[free.unknowns[i]][free.unknowns[k]];
  }
  return free;
}

// Writes the step of all unknowns that minimises the residuals; returns false if they do not determine one (by
// Cholesky's factors, in place).
bool solve(Equations& equations, double (&step)[kAllUnknowns]) {
  auto& [count, unknowns, L, x] = equations;
  for (int i = 0; i < count; ++i) {
    for (int k = 0; k <= i; ++k) {
      double left = L[i][k];
      for (int j = 0; j < k; ++j) left -= L[i][j] * L[k][j];
      if (i == k && !(left > 0.0)) return false;  // also NaN
      L[i][k] = i == k ? std::sqrt(left) : left / L[k][k];
    }
    for (int j = 0; j < i; ++j) x[i] -= L[i][j] * x[j];
    x[i] /= L[i][i];
  }
  std::fill_n(step, kAllUnknowns, 0.0);
  for (int i = count - 1; i >= 0; --i) {
    for (int j = i + 1; j < count; ++j) x[i] -= L[j][i] * x[j];
    x[i] /= L[i][i];
    step[unknowns[i]] = -x[i];
  }
  return true;
}

void move(AlignmentState& state, const double (&step)[kAllUnknowns]) {
  Twist twist;
  std::copy_n(step, 6, twist);
  state.depth_motion = exp(twist) * state.depth_motion;
  state.gain += step[6], state.bias += step[7], state.time_offset += step[8], state.readout += step[9];
}

}  // namespace

AlignmentState descend(Aligner& aligner, const Descent& task, AlignmentState state) {
  for (int iteration = 0; iteration < task.iterations; ++iteration) {
    if (task.is_motion_known) twist_of(task.pace, state.depth_motion * task.predicted_motion, state.velocity);
    const Aligner::Result system = aligner.linearize(at_state(task, state));
    state.scales[0] = std::max(kMinScales[0], kMadToDeviation * double(system.photometric_median));  // not NaN
    state.scales[1] = std::max(kMinScales[1], kMadToDeviation * double(system.depth_median));
    if (system.sums.seen < kMinPoints) break;
    Equations equations = equations_of(system, state, task);
    double step[kAllUnknowns], longest = 0.0;
    if (!solve(equations, step)) break;
    move(state, step);
    for (int i = 0; i < 6; ++i) longest = std::max(longest, std::fabs(step[i]));
    if (longest < task.small_step) break;
  }
  return state;
}

}  // namespace splatam
