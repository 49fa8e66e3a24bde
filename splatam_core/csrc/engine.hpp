// Stages of a render: project, sort by depth, list per tile, blend; and the same way back.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "kernels.hpp"
#include "thread_pool.hpp"

namespace splatam {

constexpr std::size_t kBlock = 1024;  // Gaussians that are projected, or skipped, together
constexpr int kBounds = 7;            // of a block: smallest mean, largest mean, largest log scale

// What a forward pass leaves for its backward pass. Projected Gaussians lie in blocks of kBlock with gaps between.
struct View {
  Camera camera;
  Pose pose;
  std::size_t num_gaussians = 0;
  std::vector<Splat> splats;
  std::vector<TileRect> rects, sorted_rects;  // the latter by depth
  std::vector<std::uint32_t> ids;        // splat -> Gaussian
  std::vector<std::size_t> block_sizes;  // visible Gaussians per block
  std::vector<std::uint64_t> order, scratch;  // depth bits << 32 | splat
  std::vector<std::uint32_t> entries;         // splats, tile by tile, front to back
  std::vector<std::size_t> tile_begins;       // tiles + 1
  std::vector<SplatGradient> gradients;       // one block of num_gaussians per thread
  int tiles_x = 0, tiles_y = 0;

  TileList tile(int index) const;
};

struct MapGradients {  // each may be null: not wanted
  float *means, *log_scales, *logit_opacities, *rgb;
};

class Engine : public std::enable_shared_from_this<Engine> {
 public:
  explicit Engine(int threads) : kernels_(best_kernels()), pool_(threads) {}

  // bounds: kBounds for each block, which then may be skipped; or null.
  std::shared_ptr<View> forward(const GaussianArrays&, std::size_t count, const float* bounds, const Camera&, const Pose&,
                                const Images&);

  // Writes gradients of the visible Gaussians (map.* must be zeroed) and of the pose's twelve entries, row by row.
  void backward(View&, const GaussianArrays&, const ConstImages& drawn, const ConstImages& gradient,
                const MapGradients& map, float pose_gradient[12]);

  // One Adam step of the visible Gaussians towards a target seen from a pose (Huber). Returns the loss before it.
  double fit(const MutableGaussians&, std::size_t count, float* bounds, const AdamState&, const AdamRates&,
             const Camera&, const Pose&, const Target&);

  const char* instruction_set() const { return kernels_.name; }

 private:
  std::shared_ptr<View> borrow_view();
  std::shared_ptr<View> list(const GaussianArrays&, std::size_t count, const float* bounds, const Camera&, const Pose&);
  void project(View&, const GaussianArrays&, const float* bounds);
  float* prints(int thread, std::size_t count);  // scratch of Kernels::fit
  void sort_by_depth(View&);
  void list_tiles(View&);
  void blend(const View&, const Images&);

  const Kernels& kernels_;
  ThreadPool pool_;
  std::mutex mutex_, spare_mutex_;
  std::vector<std::vector<float>> prints_;  // per thread
  std::vector<std::unique_ptr<View>> spare_;  // kept: allocating anew costs more page faults than the work
};

}  // namespace splatam
