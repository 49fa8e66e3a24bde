// Direct alignment of a frame to a reference image of the same camera, on several threads.
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
    float photometric_median, depth_median;  // of the absolute residuals
  };

  // Linearises the residuals. The result is repeatable for a fixed number of threads.
  Result linearize(const float* brightness, const float* depth, const Camera&, const float* layers,
                   const Pose& color_motion, const Pose& depth_motion, const AlignmentSettings&);

  // Halves the size: each pixel is the mean of a 2x2 block. Depth is NaN where the block spans a depth edge.
  void halve(const float* brightness, const float* depth, int width, int height, float max_step, float* half_brightness,
             float* half_depth);

  // Writes the layers [H, W, kLayers] of an image. Depth is NaN where it changes by more than the fraction max_step
  // from one pixel to the next.
  void layers(const float* brightness, const float* depth, int width, int height, float max_step, float* layers);

 private:
  template <typename Task>
  void for_rows(int rows, Task&& task);

  const Kernels& kernels_;
  ThreadPool pool_;
};

}  // namespace splatam
