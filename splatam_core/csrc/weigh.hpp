// How far a pose may be trusted, from the sums over its residuals: what splatam_core/tracking/evidence.py does in numpy
// and explains. Numpy needs longer for matrices of this size than native code for the sums.
#pragma once

#include <stdexcept>

#include "aligner.hpp"

namespace splatam {

// What is known beside the residuals: tracking.aligner.Knowns.
struct Knowns {
  int width, height, step;  // of the images, and every n-th pixel of every n-th row was compared
  double velocity[6], prior[kUnknowns], prior_inflation;
  bool is_free[kUnknowns];
};

struct PoseWeight {
  double covariance[6][6];
  int num_open;
  double explained;
  int num_explained;
};

// A system of equations without a solution.
struct Undetermined : std::runtime_error {
  using std::runtime_error::runtime_error;
};

PoseWeight weigh(const Aligner::Evidence&, const Knowns&);

}  // namespace splatam
