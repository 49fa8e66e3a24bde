// Direct alignment of a frame to a reference picture of the same camera, on several threads.
#pragma once

#include <vector>

#include "kernels.hpp"
#include "thread_pool.hpp"

namespace splatam {

class Aligner {
 public:
  explicit Aligner(int threads) : kernels_(best_kernels()), pool_(threads) {}

  struct Result {
    AlignmentSums sums;
    float light_median, depth_median;  // of the residuals' magnitudes
  };

  // Repeatable for a fixed number of threads.
  Result linearize(const float* brightness, const float* depth, const Camera&, const float* layers,
                   const Pose& light_motion, const Pose& depth_motion, const AlignmentSettings&);

  // Half the size: averages of 2x2 blocks, and no depth (NaN) where a block is no surface.
  void halve(const float* brightness, const float* depth, int width, int height, float max_step, float* half_brightness,
             float* half_depth);

  // [H, W, kLayers] of a picture; depth is NaN where it changes by more than max_step of itself from pixel to pixel.
  void layers(const float* brightness, const float* depth, int width, int height, float max_step, float* layers);

 private:
  template <typename Task>
  void for_rows(int rows, Task&& task);

  const Kernels& kernels_;
  ThreadPool pool_;
};

}  // namespace splatam
