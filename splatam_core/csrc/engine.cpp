#include "engine.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <numeric>
#include <string>
#include <utility>

namespace splatam {
namespace {

constexpr int kDigitBits = 11;
constexpr std::uint32_t kDigits = 1u << kDigitBits;

std::size_t blocks_of(std::size_t count) { return (count + kBlock - 1) / kBlock; }

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

// Calls visit(row, columns) for each row of tiles that a splat touches.
template <typename Visit>
void visit_rows(const TileRect& rect, Visit&& visit) {
  for (int row = rect.y0; row <= rect.y1; ++row) {
    const int missed = (row == rect.y0 ? rect.missed_corners & 3 : 0) | (row == rect.y1 ? rect.missed_corners >> 2 : 0);
    visit(row, Columns{std::uint16_t(rect.x0 + (missed & 1)), std::uint16_t(rect.x1 - (missed >> 1))});
  }
}

// Makes room for `count` values; those that were there may go.
template <typename T>
void grow(std::vector<T>& values, std::size_t count) {
  if (values.capacity() < count) {  // not at once with the old ones, nor twice as many
    std::vector<T>().swap(values);
    values.reserve(count + count / 4);
  }
  if (values.size() < count) values.resize(count);
}

// The depths of the members that are sorted, as depth_bits().
struct DepthRange {
  std::uint32_t lowest = ~std::uint32_t(0), highest = 0;
};

// Sorts by two digits of the depth, counted from the lowest bit of its difference to the lowest depth that counts.
// Returns where the sorted keys are.
std::uint64_t* sorted_by_digits(std::uint64_t* keys, std::uint64_t* sorted, std::size_t count, std::uint32_t lowest,
                                int shift) {
  std::uint32_t places[2][kDigits] = {};
  const auto digit = [&](std::uint64_t key, int index) {
    return (std::uint32_t(key >> 32) - lowest) >> (shift + kDigitBits * index) & (kDigits - 1);
  };
  for (std::size_t i = 0; i < count; ++i)
    for (int index = 0; index < 2; ++index) ++places[index][digit(keys[i], index)];
  for (int index = 0; index < 2; ++index) {  // the lower digit first
    std::uint32_t place = 0;
    for (std::uint32_t& next : places[index]) place += std::exchange(next, place);
    for (std::size_t i = 0; i < count; ++i) sorted[places[index][digit(keys[i], index)]++] = keys[i];
    std::swap(keys, sorted);
  }
  return keys;
}

// Puts keys in order that are nearly so. Returns false, and may leave them in another order, if too many are not.
bool put_in_order(std::uint64_t* keys, std::size_t count) {
  std::size_t moves = 0;
  for (std::size_t i = 1; i < count; ++i) {
    const std::uint64_t key = keys[i];
    if (keys[i - 1] < key) continue;
    std::size_t at = i;
    for (; at > 0 && keys[at - 1] > key; --at) keys[at] = keys[at - 1];
    keys[at] = key;
    moves += i - at;
    if (moves > count) return false;
  }
  return true;
}

// Sorts by depth, in place or into `sorted`; returns which. Those of equal depth keep their order, which is that of the
// lower half of a key.
const std::uint64_t* sorted_by_depth(std::uint64_t* keys, std::uint64_t* sorted, std::size_t count, DepthRange range) {
  constexpr std::size_t kFew = 256;  // a radix sort has to clear its counters
  if (count < kFew) {
    std::sort(keys, keys + count);
    return keys;
  }
  int shift = 0;  // the lowest bits of a depth rarely decide
  while ((range.highest - range.lowest) >> shift >= kDigits * kDigits) ++shift;
  std::uint64_t* order = sorted_by_digits(keys, sorted, count, range.lowest, shift);
  if (shift > 0 && !put_in_order(order, count)) std::sort(order, order + count);
  return order;
}

// Lists a row's members tile by tile, front to back.
void list_tiles(View& view, int row, std::vector<std::uint64_t>& keys, std::vector<std::uint64_t>& sorted) {
  const std::size_t first = view.member_begins[row], count = view.num_members(row);
  grow(keys, count);
  grow(sorted, count);
  std::size_t *begins = view.tile_begins.data() + std::size_t(row) * view.tiles_x,
              *ends = view.tile_ends.data() + std::size_t(row) * view.tiles_x;
  // Counts where the members begin, and after which tile they end, rather than all tiles between.
  std::uint32_t begun[kMaxTiles], ended[kMaxTiles + 1];
  std::fill_n(begun, view.tiles_x, 0);
  std::fill_n(ended, view.tiles_x + 1, 0);
  const Columns* columns = view.columns.data() + first;
  DepthRange range;
  for (std::size_t i = 0; i < count; ++i) {
    const std::uint32_t depth = depth_bits(view.members[first + i].z);
    range.lowest = std::min(range.lowest, depth), range.highest = std::max(range.highest, depth);
    keys[i] = std::uint64_t(depth) << 32 | i;
    ++begun[columns[i].first];
    ++ended[columns[i].last + 1];
  }
  std::size_t place = view.entry_begins[row], open = 0;
  for (int x = 0; x < view.tiles_x; ++x) {
    open += begun[x];
    open -= ended[x];
    begins[x] = ends[x] = place;
    place += open;
  }
  const std::uint64_t* order = sorted_by_depth(keys.data(), sorted.data(), count, range);
  std::uint32_t* entries = view.entries.data();
  for (std::size_t i = 0; i < count; ++i) {
    const std::uint32_t member = std::uint32_t(order[i]);
    const Columns touched = columns[member];
    if (touched.first > touched.last) continue;
    entries[ends[touched.first]++] = member;  // no branch: whether a member ends where it begins cannot be foretold
    for (int x = touched.first + 1; x < touched.last; ++x) entries[ends[x]++] = member;
    const std::size_t at = ends[touched.last] - (touched.first == touched.last);
    entries[at] = member;
    ends[touched.last] = at + 1;
  }
}

// Calls visit(list, the row's members) for each tile of a row.
template <typename Visit>
void for_tiles(const View& view, int row, const Visit& visit) {
  const Splat* members = view.members.data() + view.member_begins[row];
  for (int x = 0; x < view.tiles_x; ++x) visit(view.tile(row * view.tiles_x + x), members);
}

// Finds where the members and the tile lists of each row begin.
void divide_into_rows(View& view) {
  const std::size_t rows = view.tiles_y;
  std::vector<std::size_t> members(rows, 0), entries(rows, 0);
  std::size_t visible = 0;
  for (std::size_t block = 0; block < view.num_blocks; ++block) {
    if (view.block_sizes[block] == 0) continue;
    visible += view.block_sizes[block];
    std::uint32_t *places = view.places.data() + rows * block, *widths = view.widths.data() + rows * block;
    for (std::size_t row = 0; row < rows; ++row) {
      entries[row] += widths[row];
      members[row] += std::exchange(places[row], std::uint32_t(members[row]));
    }
  }
  view.member_begins.assign(1, 0);
  view.entry_begins.assign(1, 0);
  for (std::size_t row = 0; row < rows; ++row) {
    view.member_begins.push_back(view.member_begins[row] + members[row]);
    view.entry_begins.push_back(view.entry_begins[row] + entries[row]);
  }
  check_entries(visible, view.entry_begins[rows], view.camera.width, view.camera.height);
  view.longest_first.resize(rows);
  std::iota(view.longest_first.begin(), view.longest_first.end(), 0);
  std::stable_sort(view.longest_first.begin(), view.longest_first.end(),
                   [&](int a, int b) { return entries[a] > entries[b]; });
  grow(view.members, view.member_begins[rows]);
  grow(view.columns, view.member_begins[rows]);
  grow(view.entries, view.entry_begins[rows]);
  grow(view.tile_begins, rows * view.tiles_x);
  grow(view.tile_ends, rows * view.tiles_x);
}

// Where the next splat of a block is among the members of each row.
class RowPlaces {
 public:
  RowPlaces(const View& view, std::size_t block) {
    const std::uint32_t* places = view.places.data() + std::size_t(view.tiles_y) * block;
    for (int row = 0; row < view.tiles_y; ++row) next_[row] = std::uint32_t(view.member_begins[row]) + places[row];
  }

  std::size_t take(int row) { return next_[row]++; }

 private:
  std::uint32_t next_[kMaxTiles];
};

void copy_members(View& view, std::size_t block) {
  if (view.block_sizes[block] == 0) return;
  RowPlaces next(view, block);
  for (std::size_t splat = block * kBlock; splat < block * kBlock + view.block_sizes[block]; ++splat)
    visit_rows(view.rects[splat], [&](int row, Columns columns) {
      const std::size_t member = next.take(row);
      view.members[member] = view.splats[splat];
      view.columns[member] = columns;
    });
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
  return {index % tiles_x * kTile, index / tiles_x * kTile, entries.data() + begin, tile_ends[index] - begin};
}

Engine::Engine(int threads)
    : kernels_(best_kernels()), threads_(threads), pool_(ThreadPool::of_process()), scratch_(threads) {
  pool_.reserve(threads);
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

// Calls task(block) for every block.
template <typename Task>
void Engine::for_blocks(const View& view, const Task& task) {
  constexpr std::size_t kMostPieces = 256;  // taking one costs more than skipping a block that is out of view
  const std::size_t pieces = std::min(view.num_blocks, kMostPieces);
  pool_.run(threads_, pieces, [&](std::size_t piece, int) {
    const std::size_t end = view.num_blocks * (piece + 1) / pieces;
    for (std::size_t block = view.num_blocks * piece / pieces; block < end; ++block) task(block);
  });
}

// Calls task(row, scratch) for every row of tiles, the longest first.
template <typename Task>
void Engine::for_rows(const View& view, const Task& task) {
  pool_.run(threads_, std::size_t(view.tiles_y),
            [&](std::size_t piece, int worker) { task(view.longest_first[piece], scratch_[worker]); });
}

std::shared_ptr<View> Engine::forward(const GaussianArrays& gaussians, std::size_t count, const float* bounds,
                                      const Camera& camera, const Pose& pose, const Images& images) {
  std::lock_guard<std::mutex> lock(mutex_);
  auto view = project(gaussians, count, bounds, camera, pose);
  for_rows(*view, [&](int row, Scratch& scratch) {
    list_tiles(*view, row, scratch.keys, scratch.sorted);
    for_tiles(*view, row,
              [&](const TileList& tile, const Splat* members) { kernels_.forward(tile, members, camera, images); });
  });
  return view;
}

std::shared_ptr<View> Engine::project(const GaussianArrays& gaussians, std::size_t count, const float* bounds,
                                      const Camera& camera, const Pose& pose) {
  check_size(camera.width, camera.height);
  if (count > std::numeric_limits<std::uint32_t>::max())
    throw TooLarge(std::to_string(count) + " Gaussians cannot be drawn: expected less than 2^32");
  auto view = borrow_view();
  view->camera = camera;
  view->pose = pose;
  view->num_gaussians = count;
  view->num_blocks = blocks_of(count);
  view->tiles_x = (camera.width + kTile - 1) / kTile;
  view->tiles_y = (camera.height + kTile - 1) / kTile;
  grow(view->splats, count);
  grow(view->rects, count);
  grow(view->ids, count);
  grow(view->block_sizes, view->num_blocks);
  grow(view->places, view->num_blocks * view->tiles_y);
  grow(view->widths, view->num_blocks * view->tiles_y);
  for_blocks(*view, [&](std::size_t block) { project_block(*view, block, gaussians, bounds); });
  divide_into_rows(*view);
  for_blocks(*view, [&](std::size_t block) { copy_members(*view, block); });
  return view;
}

void Engine::project_block(View& view, std::size_t block, const GaussianArrays& gaussians, const float* bounds) {
  view.block_sizes[block] = 0;
  if (bounds && !may_be_seen(bounds + kBounds * block, view.camera, view.pose)) return;
  const std::size_t begin = block * kBlock, end = std::min(view.num_gaussians, begin + kBlock);
  view.block_sizes[block] = kernels_.project(gaussians, view.camera, view.pose, begin, end, view.splats.data(),
                                             view.rects.data(), view.ids.data());
  std::uint32_t *members = view.places.data() + view.tiles_y * block,
                *widths = view.widths.data() + view.tiles_y * block;
  std::fill_n(members, view.tiles_y, 0);
  std::fill_n(widths, view.tiles_y, 0);
  for (std::size_t splat = begin; splat < begin + view.block_sizes[block]; ++splat)
    visit_rows(view.rects[splat], [=](int row, Columns columns) {
      ++members[row];
      widths[row] += std::uint32_t(columns.last + 1 - columns.first);
    });
}

namespace {

// The gradients of the members take the place of the splats, which have become members.
static_assert(sizeof(SplatGradient) == sizeof(Splat) && alignof(SplatGradient) == alignof(Splat));

void make_room_for_gradients(View& view) { grow(view.splats, view.member_begins.back()); }

SplatGradient* gradients_of(View& view) { return reinterpret_cast<SplatGradient*>(view.splats.data()); }

// Clears the gradients of a row's members and returns them.
SplatGradient* cleared_gradients(View& view, int row) {
  SplatGradient* gradients = gradients_of(view) + view.member_begins[row];
  std::uninitialized_fill_n(gradients, view.num_members(row), SplatGradient{});
  return gradients;
}

// The splats of a block, and their gradients.
struct BlockSums {
  std::array<Splat, kBlock> splats;
  std::array<SplatGradient, kBlock> gradients;
};

// Sums the gradients of a block's splats over the rows.
void sum_gradients(View& view, std::size_t block, BlockSums& sums) {
  const SplatGradient* gradients = gradients_of(view);
  RowPlaces next(view, block);
  for (std::size_t i = 0; i < view.block_sizes[block]; ++i) {
    SplatGradient sum{};
    std::size_t member = 0;
    visit_rows(view.rects[block * kBlock + i], [&](int row, Columns) {
      member = next.take(row);
      const SplatGradient& g = gradients[member];
      sum.log_alpha += g.log_alpha, sum.dx += g.dx, sum.dy += g.dy, sum.squared += g.squared;
      sum.r += g.r, sum.g += g.g, sum.b += g.b, sum.z += g.z;
    });
    sums.splats[i] = view.members[member];
    sums.gradients[i] = sum;
  }
}

}  // namespace

float* Engine::Scratch::for_splats(std::size_t count) {
  constexpr std::size_t kVector = kScratchAlignment / sizeof(float);
  grow(of_splats, scratch_of(count) + kVector);
  const auto address = reinterpret_cast<std::uintptr_t>(of_splats.data()) / sizeof(float);
  return of_splats.data() + (kVector - address % kVector) % kVector;
}

void Engine::backward(View& view, const GaussianArrays& gaussians, const ConstImages& gradient, const MapGradients& map,
                      float pose_gradient[12]) {
  std::lock_guard<std::mutex> lock(mutex_);
  const bool any_map = map.means || map.log_scales || map.logit_opacities || map.rgb;
  make_room_for_gradients(view);
  for_rows(view, [&](int row, Scratch& scratch) {
    SplatGradient* gradients = cleared_gradients(view, row);
    for_tiles(view, row, [&](const TileList& tile, const Splat* members) {
      kernels_.backward(tile, members, view.camera, gradient, any_map, scratch.for_splats(tile.count), gradients);
    });
  });
  std::vector<std::array<double, 12>> pose_sums(view.num_blocks);
  for_blocks(view, [&](std::size_t block) {
    BlockSums sums;
    sum_gradients(view, block, sums);
    kernels_.project_back(sums.splats.data(), view.ids.data() + block * kBlock, sums.gradients.data(),
                          view.block_sizes[block], view.camera, view.pose, gaussians.means, map,
                          pose_sums[block].data());
  });
  for (int entry = 0; entry < 12; ++entry) {
    double sum = 0.0;
    for (const auto& block : pose_sums) sum += block[entry];
    pose_gradient[entry] = float(sum);
  }
}

double Engine::fit(const MutableGaussians& gaussians, std::size_t count, float* bounds, const AdamState& adam,
                   const AdamRates& rates, const Camera& camera, const Pose& pose, const Target& target) {
  std::lock_guard<std::mutex> lock(mutex_);
  const GaussianArrays now{gaussians.means, gaussians.log_scales, gaussians.logit_opacities, gaussians.rgb};
  auto view = project(now, count, bounds, camera, pose);
  make_room_for_gradients(*view);
  std::vector<double> losses(view->tiles_y, 0.0);
  for_rows(*view, [&](int row, Scratch& scratch) {
    list_tiles(*view, row, scratch.keys, scratch.sorted);
    SplatGradient* gradients = cleared_gradients(*view, row);
    double loss = 0.0;
    for_tiles(*view, row, [&](const TileList& tile, const Splat* members) {
      loss += kernels_.fit(tile, members, camera, target, scratch.for_splats(tile.count), gradients);
    });
    losses[row] = loss;
  });
  for_blocks(*view, [&](std::size_t block) {
    if (view->block_sizes[block] == 0) return;
    BlockSums sums;
    sum_gradients(*view, block, sums);
    kernels_.update(sums.splats.data(), view->ids.data() + block * kBlock, sums.gradients.data(),
                    view->block_sizes[block], camera, pose, gaussians, adam, rates,
                    bounds ? bounds + kBounds * block : nullptr);
  });
  double loss = 0.0;
  for (const double of_row : losses) loss += of_row;
  return loss;
}

}  // namespace splatam
