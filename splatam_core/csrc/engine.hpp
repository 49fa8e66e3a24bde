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

// A Gaussian's columns of tiles in one row of tiles: first..last, none if first > last.
struct Columns {
  std::uint16_t first, last;
};

// What a forward pass stores for its backward pass. Projected Gaussians (splats) are stored in blocks of kBlock, with
// gaps. Each row of tiles has copies (members) of the splats that touch it, in the order of the map, and its own sums
// of their gradients, which are then added row by row. So neither sums nor memory depend on the number of threads. The
// gradients take the place of the splats.
// Vectors are as long as the largest view needed, so that they are not cleared again and again.
struct View {
  Camera camera;
  Pose pose;
  std::size_t num_gaussians = 0, num_blocks = 0;
  int tiles_x = 0, tiles_y = 0;

  std::vector<Splat> splats;  // until they are members; then gradients
  std::vector<TileRect> rects;
  std::vector<std::uint32_t> ids;        // splat -> Gaussian
  std::vector<std::size_t> block_sizes;  // visible Gaussians per block
  std::vector<std::uint32_t> places;     // [blocks, rows]: where a block's splats begin among a row's members
  std::vector<std::uint32_t> widths;     // [blocks, rows]: entries of a block's splats in the lists of a row's tiles

  std::vector<std::size_t> member_begins;  // rows + 1
  std::vector<Splat> members;              // row by row
  std::vector<Columns> columns;            // of the members

  std::vector<std::size_t> entry_begins;            // rows + 1
  std::vector<std::size_t> tile_begins, tile_ends;  // of a tile's entries
  std::vector<std::uint32_t> entries;  // members, counted from the row's first, tile by tile, front to back
  std::vector<int> longest_first;      // rows, by entries

  TileList tile(int index) const;
  std::size_t num_members(int row) const { return member_begins[row + 1] - member_begins[row]; }
};

// Its results do not depend on the number of threads, bit for bit. Calls may come from several threads; one that
// finds the engine at work waits.
class Engine : public std::enable_shared_from_this<Engine> {
 public:
  explicit Engine(int threads);

  // bounds: [blocks, kBounds], by which blocks out of view are skipped; may be null.
  std::shared_ptr<View> forward(const GaussianArrays&, std::size_t count, const float* bounds, const Camera&,
                                const Pose&, const Images&);

  // Writes the gradients by the visible Gaussians (the others are not written: zero map.* before) and by the upper
  // three rows of the pose.
  void backward(View&, const GaussianArrays&, const ConstImages& gradient, const MapGradients& map,
                float pose_gradient[12]);

  // Takes one Adam step of the visible Gaussians towards a target (Huber loss). Returns the loss before the step.
  double fit(const MutableGaussians&, std::size_t count, float* bounds, const AdamState&, const AdamRates&,
             const Camera&, const Pose&, const Target&);

  const char* instruction_set() const { return kernels_.name; }

 private:
  // Memory of one thread, reused.
  struct Scratch {
    std::vector<std::uint64_t> keys, sorted;  // depth bits << 32 | member
    std::vector<float> of_splats;             // of Kernels::backward and Kernels::fit

    float* for_splats(std::size_t count);
  };

  std::shared_ptr<View> borrow_view();
  std::shared_ptr<View> project(const GaussianArrays&, std::size_t count, const float* bounds, const Camera&,
                                const Pose&);
  void project_block(View&, std::size_t block, const GaussianArrays&, const float* bounds);

  template <typename Task>
  void for_blocks(const View&, const Task& task);
  template <typename Task>
  void for_rows(const View&, const Task& task);

  const Kernels& kernels_;
  const int threads_;
  ThreadPool& pool_;
  std::mutex mutex_, spare_mutex_;
  std::vector<Scratch> scratch_;              // per worker of the pool
  std::vector<std::unique_ptr<View>> spare_;  // reused: page faults of new memory cost more than the work
};

}  // namespace splatam
