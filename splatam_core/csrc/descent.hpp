// Gauss-Newton at one resolution, as splatam_core/tracking/descent.py does it with any aligner. A step's arithmetic is
// on ten numbers: in Python it takes as long as the sums over all pixels.
#pragma once

#include "aligner.hpp"
#include "se3.hpp"

namespace splatam {

// Those of AlignmentSums and the time that reading an image takes.
constexpr int kAllUnknowns = kUnknowns + 1;

// What is refined; see AlignmentState in tracking/aligner.py.
struct AlignmentState {
  Motion depth_motion;
  double gain, bias, time_offset;
  Twist velocity;
  double readout;
  double scales[2];  // of the residuals: brightness, relative depth
};

// How the camera is expected to move from frame to frame; see Pace in tracking/pace.py.
struct Pace {
  double num_frames;
  Twist expected;
  double limit_m, limit_rad;
};

// See Descent in tracking/aligner.py.
struct Descent {
  Aligned images;  // without motions and what else a state holds
  bool is_motion_known;
  Motion predicted_motion;
  Pace pace;
  double mean[kAllUnknowns], information[kAllUnknowns];  // what is known before
  bool is_free[kAllUnknowns];
  double scale_factors[2];
  int iterations;
  double small_step;  // m and rad
};

// Returns the state after at most so many steps.
AlignmentState descend(Aligner&, const Descent&, AlignmentState);

}  // namespace splatam
