// Blends ellipses front to back over tiles of 8x8 pixels, and the backward pass of that: the image half of the
// anisotropic rasterizer. The projection to ellipses is in rasterizer/ewa.py.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "thread_pool.hpp"

namespace splatam {

constexpr int kShape = 6;     // of an ellipse: u, v, inverse covariance xx xy yy, opacity
constexpr int kFeatures = 4;  // red, green, blue, z
constexpr int kChannels = 5;  // of the image: the features and the silhouette

// The ellipses that may touch each tile, front to back. A row of tiles has a list of its own of the ellipses that touch
// it (members), so that a gradient can be summed row by row.
struct TileLists {
  int width = 0, height = 0, tiles_x = 0, tiles_y = 0;
  std::size_t count = 0;                   // of the ellipses
  std::vector<std::size_t> member_begins;  // rows + 1
  std::vector<std::uint32_t> members;      // ellipses, row by row, front to back
  std::vector<std::size_t> begins;         // tiles + 1
  std::vector<std::uint32_t> entries;      // members, counted from the row's first, tile by tile
};

// Its results do not depend on the number of threads, bit for bit. Calls may come from several threads at once.
class Blender {
 public:
  explicit Blender(int threads) : threads_(threads), pool_(ThreadPool::of_process()) { pool_.reserve(threads); }

  // shapes: [count, kShape] front to back; features: [count, kFeatures]; image: [kChannels, height, width].
  std::shared_ptr<TileLists> forward(const float* shapes, const float* features, std::size_t count, int width,
                                     int height, float* image);

  // image: what forward drew; gradients: of a loss by it. Writes the loss's gradients by shapes and features.
  void backward(const TileLists&, const float* shapes, const float* features, std::size_t count, const float* image,
                const float* gradients, float* shape_gradients, float* feature_gradients);

 private:
  const int threads_;
  ThreadPool& pool_;
};

}  // namespace splatam
