// The stages of a render (project, sort by depth, list per tile, blend) and of its backward pass.
#pragma once

#include <memory>
#include <mutex>
#include <stdexcept>
#include <vector>

#include "kernels.hpp"
#include "thread_pool.hpp"

namespace splatam {

constexpr std::size_t kBlock = 1024;  // Gaussians per block; a block is projected or skipped as a whole
constexpr int kBounds = 7;            // floats per block: smallest mean (3), largest mean (3), largest log scale

// A view that cannot be drawn: what it would need and what is allowed.
struct TooLarge : std::length_error {
  using std::length_error::length_error;
};

// Throws TooLarge unless an image has 1 to kMaxSide pixels a side, so that its tiles fit into a TileRect.
void check_size(int width, int height);

// Throws TooLarge if the tiles of an image have more than kMaxEntries entries.
void check_entries(std::size_t count, std::size_t entries, int width, int height);

// What a forward pass stores for its backward pass. Projected Gaussians are stored in blocks of kBlock, with gaps.
struct View {
  Camera camera;
  Pose pose;
  std::size_t num_gaussians = 0;
  std::vector<Splat> splats;
  std::vector<TileRect> rects, sorted_rects;  // the latter by depth
  std::vector<std::uint32_t> ids;             // splat -> Gaussian
  std::vector<std::size_t> block_sizes;       // visible Gaussians per block
  std::vector<std::uint64_t> order, scratch;  // depth bits << 32 | splat
  std::vector<std::uint32_t> entries;         // splats, tile by tile, front to back
  std::vector<std::size_t> tile_begins;       // tiles + 1
  std::vector<SplatGradient> gradients;       // one block of num_gaussians per thread
  int tiles_x = 0, tiles_y = 0;

  TileList tile(int index) const;
};

struct MapGradients {  // null where a gradient is not wanted
  float *means, *log_scales, *logit_opacities, *rgb;
};

class Engine : public std::enable_shared_from_this<Engine> {
 public:
  explicit Engine(int threads) : kernels_(best_kernels()), pool_(threads) {}

  // bounds: [blocks, kBounds], by which blocks out of view are skipped; may be null.
  std::shared_ptr<View> forward(const GaussianArrays&, std::size_t count, const float* bounds, const Camera&,
                                const Pose&, const Images&);

  // Writes the gradients by the visible Gaussians (the others are not written: zero map.* before) and by the upper
  // three rows of the pose.
  void backward(View&, const GaussianArrays&, const ConstImages& drawn, const ConstImages& gradient,
                const MapGradients& map, float pose_gradient[12]);

  // Takes one Adam step of the visible Gaussians towards a target (Huber loss). Returns the loss before the step.
  double fit(const MutableGaussians&, std::size_t count, float* bounds, const AdamState&, const AdamRates&,
             const Camera&, const Pose&, const Target&);

  const char* instruction_set() const { return kernels_.name; }

 private:
  std::shared_ptr<View> borrow_view();
  std::shared_ptr<View> list(const GaussianArrays&, std::size_t count, const float* bounds, const Camera&, const Pose&);
  void project(View&, const GaussianArrays&, const float* bounds);
  float* footprints(int thread, std::size_t count);  // scratch of Kernels::fit
  void sort_by_depth(View&);
  void list_tiles(View&);
  void blend(const View&, const Images&);

  const Kernels& kernels_;
  ThreadPool pool_;
  std::mutex mutex_, spare_mutex_;
  std::vector<std::vector<float>> footprints_;  // per thread
  std::vector<std::unique_ptr<View>> spare_;    // reused: page faults of new memory cost more than the work
};

}  // namespace splatam
