#include "blender.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "engine.hpp"

namespace splatam {
namespace {

constexpr int kTileSize = 8;
constexpr std::size_t kValues = kShape + kFeatures;
constexpr int kTilePixels = kTileSize * kTileSize;
constexpr float kMaximumAlpha = 0.99f, kMinimumAlpha = 1.0f / 255.0f, kMinimumTransmittance = 1e-4f;

struct Box {  // pixels, the last ones included
  int left, top, right, bottom;
  bool empty() const { return left > right || top > bottom; }
};

// Returns the box in which alpha is at least its minimum, with a margin of 0.01 px for rounding.
Box box_of(const float* shape, int width, int height) {
  const float u = shape[0], v = shape[1], a = shape[2], b = shape[3], c = shape[4];
  const float determinant = a * c - b * b, reach = 2 * std::log(shape[5] / kMinimumAlpha) / determinant;
  const float half_x = std::sqrt(reach * c) + 1e-2f, half_y = std::sqrt(reach * a) + 1e-2f;
  if (!(determinant > 0 && reach > 0 && std::isfinite(u + v + half_x + half_y))) return {0, 0, -1, -1};
  const auto clipped = [](float value, int size) { return int(std::min(std::max(value, -1.0f), float(size))); };
  return {std::max(0, clipped(std::ceil(u - half_x), width)), std::max(0, clipped(std::ceil(v - half_y), height)),
          std::min(width - 1, clipped(std::floor(u + half_x), width)),
          std::min(height - 1, clipped(std::floor(v + half_y), height))};
}

std::shared_ptr<TileLists> list(const float* shapes, std::size_t count, int width, int height) {
  check_size(width, height);
  auto lists = std::make_shared<TileLists>();
  lists->width = width, lists->height = height, lists->count = count;
  lists->tiles_x = (width + kTileSize - 1) / kTileSize, lists->tiles_y = (height + kTileSize - 1) / kTileSize;
  std::vector<Box> boxes(count);
  for (std::size_t i = 0; i < count; ++i) boxes[i] = box_of(shapes + kShape * i, width, height);
  const auto for_each_row = [&](const auto& visit) {
    for (std::size_t i = 0; i < count; ++i)
      if (!boxes[i].empty())
        for (int y = boxes[i].top / kTileSize; y <= boxes[i].bottom / kTileSize; ++y)
          visit(i, y, y * lists->tiles_x + boxes[i].left / kTileSize, y * lists->tiles_x + boxes[i].right / kTileSize);
  };
  auto &begins = lists->begins, &member_begins = lists->member_begins;
  begins.assign(std::size_t(lists->tiles_x) * lists->tiles_y + 1, 0);
  member_begins.assign(std::size_t(lists->tiles_y) + 1, 0);
  for_each_row([&](std::size_t, int row, int first, int last) {
    ++member_begins[row + 1];
    for (int tile = first; tile <= last; ++tile) ++begins[tile + 1];
  });
  std::partial_sum(begins.begin(), begins.end(), begins.begin());
  std::partial_sum(member_begins.begin(), member_begins.end(), member_begins.begin());
  check_entries(count, begins.back(), width, height);
  lists->entries.resize(begins.back());
  lists->members.resize(member_begins.back());
  auto next = begins, next_member = member_begins;
  for_each_row([&](std::size_t i, int row, int first, int last) {
    const std::size_t member = next_member[row]++;
    lists->members[member] = std::uint32_t(i);
    for (int tile = first; tile <= last; ++tile)
      lists->entries[next[tile]++] = std::uint32_t(member - member_begins[row]);
  });
  return lists;
}

// Calls visit(pixel in the tile, pixel in the image, dx, dy, alpha before it is clamped) for each pixel that an ellipse
// covers and that is not saturated.
template <typename Visit>
void for_each_covered(const Box& tile, const float* shape, int width, int height, const float* transmittance,
                      const Visit& visit) {
  const Box box = box_of(shape, width, height);
  const int left = std::max(tile.left, box.left), right = std::min(tile.right, box.right);
  for (int y = std::max(tile.top, box.top); y <= std::min(tile.bottom, box.bottom); ++y) {
    for (int x = left; x <= right; ++x) {
      const int local = (y - tile.top) * kTileSize + x - tile.left;
      if (transmittance[local] < kMinimumTransmittance) continue;
      const float dx = float(x) - shape[0], dy = float(y) - shape[1];
      const float distance = shape[2] * dx * dx + 2 * shape[3] * dx * dy + shape[4] * dy * dy;
      const float alpha = shape[5] * std::exp(-0.5f * distance);
      if (alpha >= kMinimumAlpha) visit(local, std::size_t(y) * width + x, dx, dy, alpha);
    }
  }
}

Box pixels_of(const TileLists& lists, int tile) {
  const int x = tile % lists.tiles_x * kTileSize, y = tile / lists.tiles_x * kTileSize;
  return {x, y, std::min(x + kTileSize, lists.width) - 1, std::min(y + kTileSize, lists.height) - 1};
}

void blend_tile(const TileLists& lists, int tile, const float* shapes, const float* features, float* image) {
  const Box pixels = pixels_of(lists, tile);
  const std::size_t size = std::size_t(lists.width) * lists.height;
  std::array<float, kTilePixels> transmittance;
  transmittance.fill(1.0f);
  const std::uint32_t* members = lists.members.data() + lists.member_begins[tile / lists.tiles_x];
  for (std::size_t entry = lists.begins[tile]; entry < lists.begins[tile + 1]; ++entry) {
    const std::uint32_t id = members[lists.entries[entry]];
    const float *shape = shapes + kShape * id, *feature = features + kFeatures * id;
    for_each_covered(pixels, shape, lists.width, lists.height, transmittance.data(),
                     [&](int local, std::size_t pixel, float, float, float alpha) {
                       alpha = std::min(alpha, kMaximumAlpha);
                       const float weight = alpha * transmittance[local];
                       for (int k = 0; k < kFeatures; ++k) image[k * size + pixel] += weight * feature[k];
                       image[kFeatures * size + pixel] += weight;
                       transmittance[local] *= 1 - alpha;
                     });
  }
}

// With w_i = alpha_i T_i and d_i the loss's gradient times the features of i, d loss / d alpha_i = T_i d_i - B_i / (1 -
// alpha_i). B_i is the sum of w_k d_k over the ellipses k behind i: the sum over all of them, less those visited so
// far. Adds to sums, [members of the row, kShape + kFeatures].
void blend_tile_back(const TileLists& lists, int tile, const float* shapes, const float* features, const float* image,
                     const float* gradients, float* sums) {
  const Box pixels = pixels_of(lists, tile);
  const std::size_t size = std::size_t(lists.width) * lists.height;
  std::array<float, kTilePixels> transmittance, behind;
  transmittance.fill(1.0f);
  for (int y = pixels.top; y <= pixels.bottom; ++y)
    for (int x = pixels.left; x <= pixels.right; ++x) {
      float& sum = behind[(y - pixels.top) * kTileSize + x - pixels.left];
      sum = 0;
      for (int k = 0; k < kChannels; ++k) {
        const std::size_t at = k * size + std::size_t(y) * lists.width + x;
        sum += image[at] * gradients[at];
      }
    }
  const std::uint32_t* members = lists.members.data() + lists.member_begins[tile / lists.tiles_x];
  for (std::size_t entry = lists.begins[tile]; entry < lists.begins[tile + 1]; ++entry) {
    const std::uint32_t id = members[lists.entries[entry]];
    const float *shape = shapes + kShape * id, *feature = features + kFeatures * id;
    float *by_shape = sums + kValues * lists.entries[entry], *by_feature = by_shape + kShape;
    for_each_covered(pixels, shape, lists.width, lists.height, transmittance.data(),
                     [&](int local, std::size_t pixel, float dx, float dy, float unlimited) {
                       const float alpha = std::min(unlimited, kMaximumAlpha);
                       const float T = transmittance[local], weight = alpha * T;
                       float along = gradients[kFeatures * size + pixel];
                       for (int k = 0; k < kFeatures; ++k) {
                         const float gradient = gradients[k * size + pixel];
                         along += gradient * feature[k];
                         by_feature[k] += weight * gradient;
                       }
                       behind[local] -= weight * along;
                       transmittance[local] *= 1 - alpha;
                       if (unlimited > kMaximumAlpha) return;
                       const float by_alpha = T * along - behind[local] / (1 - alpha);
                       const float by_distance = -0.5f * alpha * by_alpha;
                       by_shape[0] -= by_distance * 2 * (shape[2] * dx + shape[3] * dy);
                       by_shape[1] -= by_distance * 2 * (shape[3] * dx + shape[4] * dy);
                       by_shape[2] += by_distance * dx * dx;
                       by_shape[3] += by_distance * 2 * dx * dy;
                       by_shape[4] += by_distance * dy * dy;
                       by_shape[5] += by_alpha * alpha / shape[5];
                     });
  }
}

}  // namespace

std::shared_ptr<TileLists> Blender::forward(const float* shapes, const float* features, std::size_t count, int width,
                                            int height, float* image) {
  auto lists = list(shapes, count, width, height);
  std::fill_n(image, std::size_t(kChannels) * width * height, 0.0f);
  pool_.run(threads_, std::size_t(lists->tiles_y), [&](std::size_t row, int) {
    for (int x = 0; x < lists->tiles_x; ++x) blend_tile(*lists, int(row) * lists->tiles_x + x, shapes, features, image);
  });
  return lists;
}

void Blender::backward(const TileLists& lists, const float* shapes, const float* features, std::size_t count,
                       const float* image, const float* gradients, float* shape_gradients, float* feature_gradients) {
  std::vector<float> sums(lists.members.size() * kValues);  // row by row, so that their order is always the same
  pool_.run(threads_, std::size_t(lists.tiles_y), [&](std::size_t row, int) {
    float* of_row = sums.data() + lists.member_begins[row] * kValues;
    for (int x = 0; x < lists.tiles_x; ++x)
      blend_tile_back(lists, int(row) * lists.tiles_x + x, shapes, features, image, gradients, of_row);
  });
  std::fill_n(shape_gradients, count * kShape, 0.0f);
  std::fill_n(feature_gradients, count * kFeatures, 0.0f);
  for (std::size_t member = 0; member < lists.members.size(); ++member) {
    const float* sum = sums.data() + member * kValues;
    for (int i = 0; i < kShape; ++i) shape_gradients[kShape * lists.members[member] + i] += sum[i];
    for (int i = 0; i < kFeatures; ++i) feature_gradients[kFeatures * lists.members[member] + i] += sum[kShape + i];
  }
}

}  // namespace splatam
