#include "engine.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <string>
#include <utility>

namespace splatam {
namespace {

constexpr int kDigitBits = 10;  // three digits hold every depth from 0.2 m on
constexpr std::size_t kDigits = std::size_t(1) << kDigitBits;

std::size_t blocks_of(std::size_t count) { return (count + kBlock - 1) / kBlock; }

// Returns where part `index` of `parts` equal parts of a range begins.
std::size_t part(std::size_t count, int index, int parts) { return count * std::size_t(index) / std::size_t(parts); }

std::uint32_t depth_bits(float z) {
  std::uint32_t bits, near;
  std::memcpy(&bits, &z, sizeof bits);
  std::memcpy(&near, &kNear, sizeof near);
  return bits - near;
}

// Returns false if no Gaussian within the bounds can reach a pixel. Returns true for bounds that are not finite.
bool may_be_seen(const float* bounds, const Camera& camera, const Pose& pose) {
  constexpr float kReach = 3.34f;      // of a Gaussian, in standard deviations: sqrt(2 ln 255), rounded up
  constexpr float kBlurReach = 1.84f;  // of the blur alone, px
  float centre[3], c[3], squared = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    centre[axis] = 0.5f * (bounds[axis] + bounds[3 + axis]);
    const float half = bounds[3 + axis] - centre[axis];
    squared += half * half;
  }
  const float radius = std::sqrt(squared), reach = kReach * camera.focal() * std::exp(std::min(bounds[6], 40.0f));
  for (int row = 0; row < 3; ++row)
    c[row] =
        pose.R[3 * row] * centre[0] + pose.R[3 * row + 1] * centre[1] + pose.R[3 * row + 2] * centre[2] + pose.t[row];
  if (c[2] + radius <= kNear) return false;
  // The camera centre and an edge of the image span a plane. A disc may reach across it.
  const auto inside = [&](float across, float focal, float pixels) {
    const float along = pixels + kBlurReach;
    return !(focal * across + along * c[2] + radius * std::sqrt(focal * focal + along * along) + reach < 0.0f);
  };
  return inside(c[0], camera.fx, camera.cx) && inside(-c[0], camera.fx, float(camera.width - 1) - camera.cx) &&
         inside(c[1], camera.fy, camera.cy) && inside(-c[1], camera.fy, float(camera.height - 1) - camera.cy);
}

// Calls visit(tile) for each tile that a splat touches.
template <typename Visit>
void visit_tiles(const TileRect& rect, int tiles_x, Visit&& visit) {
  for (int y = rect.y0; y <= rect.y1; ++y) {
    const int missed = (y == rect.y0 ? rect.missed_corners & 3 : 0) | (y == rect.y1 ? rect.missed_corners >> 2 : 0);
    for (int x = rect.x0 + (missed & 1); x <= rect.x1 - (missed >> 1); ++x) visit(y * tiles_x + x);
  }
}

}  // namespace

void check_size(int width, int height) {
  if (width < 1 || height < 1 || width > kMaxSide || height > kMaxSide)
    throw TooLarge("an image of " + std::to_string(width) + "x" + std::to_string(height) +
                   " pixels cannot be drawn: expected 1 to " + std::to_string(kMaxSide) + " a side");
}

void check_entries(std::size_t count, std::size_t entries, int width, int height) {
  if (entries > kMaxEntries)
    throw TooLarge(std::to_string(count) + " Gaussians cover " + std::to_string(entries) + " tiles of 8x8 pixels in " +
                   std::to_string(width) + "x" + std::to_string(height) + " pixels, at most " +
                   std::to_string(kMaxEntries) + " can be drawn: draw smaller images, or a map of smaller Gaussians");
}

TileList View::tile(int index) const {
  const std::size_t begin = tile_begins[index];
  return {index % tiles_x * kTile, index / tiles_x * kTile, entries.data() + begin, tile_begins[index + 1] - begin};
}

std::shared_ptr<View> Engine::borrow_view() {
  std::unique_ptr<View> view;
  {
    std::lock_guard<std::mutex> lock(spare_mutex_);
    if (!spare_.empty()) {
      view = std::move(spare_.back());
      spare_.pop_back();
    }
  }
  if (!view) view = std::make_unique<View>();
  auto engine = shared_from_this();
  return std::shared_ptr<View>(view.release(), [engine](View* returned) {
    std::unique_ptr<View> owned(returned);
    std::lock_guard<std::mutex> lock(engine->spare_mutex_);
    try {
      engine->spare_.push_back(std::move(owned));
    } catch (const std::bad_alloc&) {  // a deleter must not throw; the view is freed
    }
  });
}

std::shared_ptr<View> Engine::forward(const GaussianArrays& gaussians, std::size_t count, const float* bounds,
                                      const Camera& camera, const Pose& pose, const Images& images) {
  std::lock_guard<std::mutex> lock(mutex_);
  auto view = list(gaussians, count, bounds, camera, pose);
  blend(*view, images);
  return view;
}

std::shared_ptr<View> Engine::list(const GaussianArrays& gaussians, std::size_t count, const float* bounds,
                                   const Camera& camera, const Pose& pose) {
  check_size(camera.width, camera.height);
  if (count > std::numeric_limits<std::uint32_t>::max())
    throw TooLarge(std::to_string(count) + " Gaussians cannot be drawn: expected less than 2^32");
  auto view = borrow_view();
  view->camera = camera;
  view->pose = pose;
  view->num_gaussians = count;
  view->tiles_x = (camera.width + kTile - 1) / kTile;
  view->tiles_y = (camera.height + kTile - 1) / kTile;
  project(*view, gaussians, bounds);
  sort_by_depth(*view);
  list_tiles(*view);
  return view;
}

void Engine::project(View& view, const GaussianArrays& gaussians, const float* bounds) {
  const std::size_t count = view.num_gaussians, blocks = blocks_of(count);
  view.splats.resize(count);
  view.rects.resize(count);
  view.ids.resize(count);
  view.block_sizes.resize(blocks);
  std::atomic<std::size_t> next{0};
  pool_.run([&](int) {
    for (std::size_t block; (block = next.fetch_add(1)) < blocks;)
      view.block_sizes[block] = bounds && !may_be_seen(bounds + kBounds * block, view.camera, view.pose)
                                    ? 0
                                    : kernels_.project(gaussians, view.camera, view.pose, block * kBlock,
                                                       std::min(count, (block + 1) * kBlock), view.splats.data(),
                                                       view.rects.data(), view.ids.data());
  });
}

// Stable radix sort, lowest digit first: Gaussians of equal depth keep the order of the map.
void Engine::sort_by_depth(View& view) {
  std::vector<std::size_t> begins(view.block_sizes.size() + 1, 0);
  for (std::size_t block = 0; block < view.block_sizes.size(); ++block)
    begins[block + 1] = begins[block] + view.block_sizes[block];
  const std::size_t visible = begins.back();
  view.order.resize(visible);
  view.scratch.resize(visible);
  const int parts = pool_.size();
  pool_.run([&](int thread) {
    const std::size_t last = part(view.block_sizes.size(), thread + 1, parts);
    for (std::size_t block = part(view.block_sizes.size(), thread, parts); block < last; ++block)
      for (std::size_t i = 0; i < view.block_sizes[block]; ++i) {
        const std::size_t splat = block * kBlock + i;
        view.order[begins[block] + i] = std::uint64_t(depth_bits(view.splats[splat].z)) << 32 | splat;
      }
  });
  std::vector<std::array<std::size_t, kDigits>> places(parts);
  for (int shift = 32; shift < 32 + 3 * kDigitBits; shift += kDigitBits) {
    const auto digit = [shift](std::uint64_t key) { return key >> shift & (kDigits - 1); };
    pool_.run([&](int thread) {
      places[thread].fill(0);
      const std::size_t last = part(visible, thread + 1, parts);
      for (std::size_t i = part(visible, thread, parts); i < last; ++i) ++places[thread][digit(view.order[i])];
    });
    std::size_t place = 0;
    for (std::size_t value = 0; value < kDigits; ++value)
      for (int thread = 0; thread < parts; ++thread) place += std::exchange(places[thread][value], place);
    pool_.run([&](int thread) {
      const std::size_t last = part(visible, thread + 1, parts);
      for (std::size_t i = part(visible, thread, parts); i < last; ++i)
        view.scratch[places[thread][digit(view.order[i])]++] = view.order[i];
    });
    view.order.swap(view.scratch);
  }
}

void Engine::list_tiles(View& view) {
  const std::size_t tiles = std::size_t(view.tiles_x) * view.tiles_y, visible = view.order.size();
  const int parts = pool_.size();
  std::vector<std::uint32_t> places(tiles * parts, 0);  // [threads, tiles]: each thread lists its part of the order
  view.sorted_rects.resize(visible);
  pool_.run([&](int thread) {
    std::uint32_t* counts = places.data() + tiles * thread;
    const std::size_t last = part(visible, thread + 1, parts);
    for (std::size_t i = part(visible, thread, parts); i < last; ++i) {
      const TileRect rect = view.sorted_rects[i] = view.rects[std::uint32_t(view.order[i])];
      visit_tiles(rect, view.tiles_x, [counts](int tile) { ++counts[tile]; });
    }
  });
  std::size_t entries = 0;
  for (const std::uint32_t count : places) entries += count;
  check_entries(visible, entries, view.camera.width, view.camera.height);
  view.tile_begins.resize(tiles + 1);
  std::uint32_t place = 0;
  for (std::size_t tile = 0; tile < tiles; ++tile) {
    view.tile_begins[tile] = place;
    for (int thread = 0; thread < parts; ++thread) place += std::exchange(places[tiles * thread + tile], place);
  }
  view.tile_begins[tiles] = place;
  view.entries.resize(place);
  pool_.run([&](int thread) {
    std::uint32_t* next = places.data() + tiles * thread;
    const std::size_t last = part(visible, thread + 1, parts);
    for (std::size_t i = part(visible, thread, parts); i < last; ++i) {
      const std::uint32_t splat = std::uint32_t(view.order[i]);
      visit_tiles(view.sorted_rects[i], view.tiles_x,
                  [&view, next, splat](int tile) { view.entries[next[tile]++] = splat; });
    }
  });
}

void Engine::blend(const View& view, const Images& images) {
  const int tiles = view.tiles_x * view.tiles_y;
  std::atomic<int> next{0};
  pool_.run([&](int) {
    for (int tile; (tile = next.fetch_add(1)) < tiles;)
      kernels_.forward(view.tile(tile), view.splats.data(), view.camera, images);
  });
}

namespace {

// Adds a splat's gradient to the pose's, and writes its Gaussian's where that is wanted.
void project_backward(const View& view, std::size_t splat, const SplatGradient& g, const GaussianArrays& gaussians,
                      const MapGradients& map, double pose_gradient[12]) {
  const std::size_t id = view.ids[splat];
  const GaussianGradient by_gaussian = through_projection(view.splats[splat], g, view.camera);
  const float *mean = gaussians.means + 3 * id, *d = by_gaussian.camera;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) pose_gradient[4 * row + column] += double(d[row]) * mean[column];
    pose_gradient[4 * row + 3] += d[row];
  }
  if (map.means)
    for (int axis = 0; axis < 3; ++axis)
      map.means[3 * id + axis] = view.pose.R[axis] * d[0] + view.pose.R[3 + axis] * d[1] + view.pose.R[6 + axis] * d[2];
  if (map.log_scales) map.log_scales[id] = by_gaussian.log_scale;
  if (map.logit_opacities) map.logit_opacities[id] = by_gaussian.logit_opacity;
  if (map.rgb) {
    map.rgb[3 * id] = g.r;
    map.rgb[3 * id + 1] = g.g;
    map.rgb[3 * id + 2] = g.b;
  }
}

// Returns the gradients of one thread, set to zero where there are splats.
SplatGradient* cleared_gradients(View& view, int thread) {
  SplatGradient* mine = view.gradients.data() + view.num_gaussians * thread;
  for (std::size_t block = 0; block < view.block_sizes.size(); ++block)
    std::fill_n(mine + block * kBlock, view.block_sizes[block], SplatGradient{});
  return mine;
}

// Sums the gradients of all threads into those of the first.
const SplatGradient& summed_gradient(View& view, std::size_t splat, int parts) {
  SplatGradient& sum = view.gradients[splat];
  for (int thread = 1; thread < parts; ++thread) {
    const SplatGradient& g = view.gradients[view.num_gaussians * thread + splat];
    sum.log_alpha += g.log_alpha, sum.dx += g.dx, sum.dy += g.dy, sum.squared += g.squared;
    sum.r += g.r, sum.g += g.g, sum.b += g.b, sum.z += g.z;
  }
  return sum;
}

// Divides the tiles into runs of about equal work. The division depends on the view alone, so that sums are repeatable.
std::vector<int> balanced_runs(const View& view, int parts) {
  std::vector<int> begins(parts + 1);
  for (int index = 0; index <= parts; ++index) {
    const std::size_t entry = part(view.entries.size(), index, parts);
    begins[index] =
        int(std::lower_bound(view.tile_begins.begin(), view.tile_begins.end() - 1, entry) - view.tile_begins.begin());
  }
  begins[0] = 0;
  begins[parts] = view.tiles_x * view.tiles_y;
  return begins;
}

}  // namespace

void Engine::backward(View& view, const GaussianArrays& gaussians, const ConstImages& drawn,
                      const ConstImages& gradient, const MapGradients& map, float pose_gradient[12]) {
  std::lock_guard<std::mutex> lock(mutex_);
  const int parts = pool_.size();
  const std::size_t count = view.num_gaussians, blocks = view.block_sizes.size();
  const auto runs = balanced_runs(view, parts);
  const bool any_map = map.means || map.log_scales || map.logit_opacities || map.rgb;
  view.gradients.resize(count * parts);
  pool_.run([&](int thread) {
    SplatGradient* mine = cleared_gradients(view, thread);
    for (int tile = runs[thread]; tile < runs[thread + 1]; ++tile)
      kernels_.backward(view.tile(tile), view.splats.data(), view.camera, drawn, gradient, any_map, mine);
  });
  std::vector<std::array<double, 12>> pose_sums(blocks);
  std::atomic<std::size_t> next{0};
  pool_.run([&](int) {
    for (std::size_t block; (block = next.fetch_add(1)) < blocks;) {
      pose_sums[block].fill(0.0);
      for (std::size_t splat = block * kBlock; splat < block * kBlock + view.block_sizes[block]; ++splat) {
        const SplatGradient& sum = summed_gradient(view, splat, parts);
        project_backward(view, splat, sum, gaussians, map, pose_sums[block].data());
      }
    }
  });
  for (int entry = 0; entry < 12; ++entry) {
    double sum = 0.0;
    for (const auto& block : pose_sums) sum += block[entry];
    pose_gradient[entry] = float(sum);
  }
}

float* Engine::footprints(int thread, std::size_t count) {
  constexpr std::size_t kVector = 8;  // floats; the kernels need aligned vectors
  auto& scratch = footprints_[thread];
  if (scratch.size() < count * kFloatsPerFootprint + kVector) scratch.resize(2 * count * kFloatsPerFootprint + kVector);
  const auto address = reinterpret_cast<std::uintptr_t>(scratch.data()) / sizeof(float);
  return scratch.data() + (kVector - address % kVector) % kVector;
}

double Engine::fit(const MutableGaussians& gaussians, std::size_t count, float* bounds, const AdamState& adam,
                   const AdamRates& rates, const Camera& camera, const Pose& pose, const Target& target) {
  std::lock_guard<std::mutex> lock(mutex_);
  const GaussianArrays now{gaussians.means, gaussians.log_scales, gaussians.logit_opacities, gaussians.rgb};
  auto view = list(now, count, bounds, camera, pose);
  const int parts = pool_.size();
  const auto runs = balanced_runs(*view, parts);
  std::vector<double> losses(parts, 0.0);
  footprints_.resize(parts);
  view->gradients.resize(count * parts);
  pool_.run([&](int thread) {
    SplatGradient* mine = cleared_gradients(*view, thread);
    for (int tile = runs[thread]; tile < runs[thread + 1]; ++tile) {
      const TileList list = view->tile(tile);
      losses[thread] += kernels_.fit(list, view->splats.data(), camera, target, footprints(thread, list.count), mine);
    }
  });
  std::atomic<std::size_t> next{0};
  pool_.run([&](int) {
    for (std::size_t block; (block = next.fetch_add(1)) < view->block_sizes.size();) {
      const std::size_t begin = block * kBlock, end = begin + view->block_sizes[block];
      for (std::size_t splat = begin; splat < end; ++splat) summed_gradient(*view, splat, parts);
      kernels_.update(view->splats.data(), view->ids.data(), view->gradients.data(), begin, end, camera, pose,
                      gaussians, adam, rates, bounds ? bounds + kBounds * block : nullptr);
    }
  });
  double loss = 0.0;
  for (double part : losses) loss += part;
  return loss;
}

}  // namespace splatam
