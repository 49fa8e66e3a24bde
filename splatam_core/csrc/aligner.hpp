// Direct alignment of a frame to a reference image of the same camera, on several threads. Calls may come from several
// threads at once. Results do not depend on the number of threads, bit for bit.
#pragma once

#include <vector>

#include "evidence.hpp"
#include "kernels.hpp"
#include "thread_pool.hpp"

namespace splatam {

class Aligner {
 public:
  explicit Aligner(int threads) : kernels_(best_kernels()), threads_(threads), pool_(ThreadPool::of_process()) {
    pool_.reserve(threads);
  }

  // Sums over the rows of what each adds to H and g, times when it is read (see time_of_row), and times the square of
  // that.
  struct RowMoments {
    double H1[kUnknowns * (kUnknowns + 1) / 2], H2[kUnknowns * (kUnknowns + 1) / 2], g1[kUnknowns];
  };

  struct Result {
    AlignmentSums sums;
    RowMoments moments;
    float photometric_median, depth_median;  // of the absolute residuals
  };

  // Linearises the residuals.
  Result linearize(const Aligned&);

  // Sums what the residuals say about the pose.
  struct Evidence {
    double claimed[kUnknowns][kUnknowns], shared[kUnknowns][kUnknowns];
    double scores[kUnknowns][kCells], cells[kCellSums][kCells];  // see EvidenceSums; cells row by row
  };
  Evidence evidence(const Aligned&);

  // Halves the size: each pixel is the mean of a 2x2 block. Depth is NaN where the block spans a depth edge.
  void halve(const float* brightness, const float* depth, int width, int height, float max_step, float* half_brightness,
             float* half_depth);

  // Writes the brightness of a frame's colours [H, W, 3], and its depth with holes of at most max_gap pixels closed,
  // along rows and then along columns, where the depths on both sides differ by at most the fraction max_step of the
  // nearer one. Inverse depth is interpolated: exact on a plane. 0 is no reading.
  void frame_images(const std::uint8_t* rgb, const float* readings, int width, int height, int max_gap, float max_step,
                    float* brightness, float* depth);

  // Writes the brightness of a render without the black behind it, and its depth; NaN where the silhouette is not above
  // `threshold`. The silhouette counts as at least `least`.
  void render_images(const ConstImages& drawn, int width, int height, float threshold, float least, float* brightness,
                     float* depth);

  // Writes the layers [H, W, kLayers] of an image. Depth is NaN where it changes by more than the fraction max_step
  // from one pixel to the next.
  void layers(const float* brightness, const float* depth, int width, int height, float max_step, float* layers);

 private:
  template <typename Task>
  void for_rows(int rows, const Task& task);

  const Kernels& kernels_;
  const int threads_;
  ThreadPool& pool_;
};

}  // namespace splatam
