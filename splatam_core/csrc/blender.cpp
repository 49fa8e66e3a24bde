#include "blender.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "engine.hpp"

namespace splatam {
namespace {

constexpr int kTileSize = 8;
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
  const auto for_each_tile = [&](const auto& visit) {
    for (std::size_t i = 0; i < count; ++i) {
      if (boxes[i].empty()) continue;
      for (int y = boxes[i].top / kTileSize; y <= boxes[i].bottom / kTileSize; ++y)
        for (int x = boxes[i].left / kTileSize; x <= boxes[i].right / kTileSize; ++x) visit(i, y * lists->tiles_x + x);
    }
  };
  auto& begins = lists->begins;
  begins.assign(std::size_t(lists->tiles_x) * lists->tiles_y + 1, 0);
  for_each_tile([&](std::size_t, int tile) { ++begins[tile + 1]; });
  for (std::size_t tile = 1; tile < begins.size(); ++tile) begins[tile] += begins[tile - 1];
  check_entries(count, begins.back(), width, height);
  lists->entries.resize(begins.back());
  auto next = begins;
  for_each_tile([&](std::size_t i, int tile) { lists->entries[next[tile]++] = std::uint32_t(i); });
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
  for (std::size_t entry = lists.begins[tile]; entry < lists.begins[tile + 1]; ++entry) {
    const float* shape = shapes + kShape * lists.entries[entry];
    const float* feature = features + kFeatures * lists.entries[entry];
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
// far.
void blend_tile_back(const TileLists& lists, int tile, const float* shapes, const float* features, const float* image,
                     const float* gradients, float* shape_gradients, float* feature_gradients) {
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
  for (std::size_t entry = lists.begins[tile]; entry < lists.begins[tile + 1]; ++entry) {
    const std::uint32_t id = lists.entries[entry];
    const float *shape = shapes + kShape * id, *feature = features + kFeatures * id;
    float *by_shape = shape_gradients + kShape * id, *by_feature = feature_gradients + kFeatures * id;
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
  const int tiles = int(lists->begins.size()) - 1;
  pool_.run([&](int thread) {
    for (int tile = thread; tile < tiles; tile += pool_.size()) blend_tile(*lists, tile, shapes, features, image);
  });
  return lists;
}

void Blender::backward(const TileLists& lists, const float* shapes, const float* features, std::size_t count,
                       const float* image, const float* gradients, float* shape_gradients, float* feature_gradients) {
  // Each tile belongs to a fixed thread, so that sums are repeatable bit for bit.
  const std::size_t per_thread = count * (kShape + kFeatures);
  std::vector<float> sums(per_thread * std::size_t(pool_.size()));
  const int tiles = int(lists.begins.size()) - 1;
  pool_.run([&](int thread) {
    float* by_shape = sums.data() + per_thread * std::size_t(thread);
    for (int tile = thread; tile < tiles; tile += pool_.size())
      blend_tile_back(lists, tile, shapes, features, image, gradients, by_shape, by_shape + count * kShape);
  });
  std::fill_n(shape_gradients, count * kShape, 0.0f);
  std::fill_n(feature_gradients, count * kFeatures, 0.0f);
  for (int thread = 0; thread < pool_.size(); ++thread) {
    const float* by_shape = sums.data() + per_thread * std::size_t(thread);
    const float* by_feature = by_shape + count * kShape;
    for (std::size_t i = 0; i < count * kShape; ++i) shape_gradients[i] += by_shape[i];
    for (std::size_t i = 0; i < count * kFeatures; ++i) feature_gradients[i] += by_feature[i];
  }
}

}  // namespace splatam
