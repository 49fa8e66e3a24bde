#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>

#include "readout.hpp"

namespace splatam {
namespace {

// An image value and its gradients along u and v, and those of depth.
struct Sample {
  float brightness, brightness_u, brightness_v, depth, depth_u, depth_v;
};

struct Point {
  float x, y, z, inverse_z, u, v;
  bool inside;
};

Point moved(const Pose& motion, const float* point, const Camera& camera) {
  const float *R = motion.R, *t = motion.t;
  Point p;
  p.x = R[0] * point[0] + R[1] * point[1] + R[2] * point[2] + t[0];
  p.y = R[3] * point[0] + R[4] * point[1] + R[5] * point[2] + t[1];
  p.z = R[6] * point[0] + R[7] * point[1] + R[8] * point[2] + t[2];
  const bool in_front = p.z > 0.0f;
  if (!in_front) p.z = 1.0f;
  p.inverse_z = 1.0f / p.z;
  p.u = camera.fx * p.x * p.inverse_z + camera.cx, p.v = camera.fy * p.y * p.inverse_z + camera.cy;
  p.inside = in_front && p.u >= 0.0f && p.v >= 0.0f && p.u < float(camera.width - 1) && p.v < float(camera.height - 1);
  return p;
}

// The layers of the reference at a pixel. Gradients are 0 at the border.
Sample reference_at(const Aligned& images, int x, int y) {
  const int width = images.camera.width;
  const std::size_t at = std::size_t(y) * width + x;
  const float *light = images.brightness + at, *depth = images.depth + at;
  Sample sample{*light, 0.0f, 0.0f, *depth, 0.0f, 0.0f};
  if (x == 0 || y == 0 || x == width - 1 || y == images.camera.height - 1) return sample;
  sample.brightness_u = 0.5f * (light[1] - light[-1]), sample.brightness_v = 0.5f * (light[width] - light[-width]);
  sample.depth_u = 0.5f * (depth[1] - depth[-1]), sample.depth_v = 0.5f * (depth[width] - depth[-width]);
  return sample;
}

// The layers of the frame at a point inside, bilinearly.
Sample frame_at(const Aligned& images, const Point& p) {
  const int column = int(p.u), row = int(p.v);
  const float right = p.u - float(column), below = p.v - float(row);
  const std::size_t under = std::size_t(images.camera.width) * kLayers;
  const float* at = images.layers + (std::size_t(row) * images.camera.width + column) * kLayers;
  float values[6];
  for (int i = 0; i < 6; ++i) {
    const float upper = at[i] * (1.0f - right) + at[i + kLayers] * right;
    const float lower = at[i + under] * (1.0f - right) + at[i + under + kLayers] * right;
    values[i] = upper * (1.0f - below) + lower * below;
  }
  return {values[0], values[1], values[2], values[3], values[4], values[5]};
}

// Writes the derivatives [6] of an image value at a point by a twist that moves the point.
void by_twist(float along_u, float along_v, const Point& p, const Camera& camera, float* derivatives) {
  const float a = along_u * camera.fx * p.inverse_z, b = along_v * camera.fy * p.inverse_z;
  const float c = -(a * p.x + b * p.y) * p.inverse_z;
  const float values[6] = {a, b, c, c * p.y - b * p.z, a * p.z - c * p.x, b * p.x - a * p.y};
  std::copy_n(values, 6, derivatives);
}

// Cosine between ray and surface normal.
float incidence_cosine(const Sample& sample, const Point& p, const Camera& camera) {
  const float across = sample.depth_u * camera.fx * p.inverse_z, down = sample.depth_v * camera.fy * p.inverse_z;
  return 1.0f / std::sqrt(1.0f + across * across + down * down);
}

// Derivatives of the residuals of a point by the unknowns, padded to vectors; 0 where it is not compared.
constexpr int kLane = 4, kVectors = (kUnknowns + kLane - 1) / kLane;
typedef float Vector __attribute__((vector_size(sizeof(float) * kLane)));
struct Jacobian {
  union {
    float brightness[kVectors * kLane];
    Vector brightness_vectors[kVectors];
  };
  union {
    float depth[2 * kLane];
    Vector depth_vectors[2];
  };
};

struct Residuals {
  bool lit, seen, met;
  float brightness, depth;                // 0 where not compared
  float brightness_weight, depth_weight;  // robust, over squared scales
};

// Student's t with five degrees of freedom, over the squared scale.
float robust_weight(float residual, float scale) {
  const float precision = 1.0f / (scale * scale);
  return 6.0f / (5.0f + residual * residual * precision) * precision;
}

Residuals residuals_of(const Aligned& images, const Sample& reference, const Sample& frame, const Point& at_color,
                       const Point& at_depth) {
  const AlignmentSettings& settings = images.settings;
  Residuals r{};
  r.met = at_depth.inside && !std::isnan(frame.depth);
  const float off = frame.depth * at_depth.inverse_z - 1.0f;
  r.seen = r.met && at_color.inside && std::fabs(off) < settings.max_depth_ratio;
  r.lit = at_color.inside && at_depth.inside && (r.seen || std::isnan(frame.depth));
  if (r.lit) r.brightness = frame.brightness - (settings.gain * reference.brightness + settings.bias);
  if (r.seen) r.depth = off * incidence_cosine(frame, at_depth, images.camera);
  r.brightness_weight = robust_weight(r.brightness, settings.photometric_scale);
  r.depth_weight = robust_weight(r.depth, settings.depth_scale);
  return r;
}

Jacobian jacobian_of(const Aligned& images, const Sample& gradients, float gain, float reference, const Point& at_color,
                     const Point& at_depth, const Residuals& r) {
  Jacobian by{};
  if (r.lit) {
    by_twist(gain * gradients.brightness_u, gain * gradients.brightness_v, at_color, images.camera, by.brightness);
    by.brightness[6] = -reference, by.brightness[7] = -1.0f;
    for (int i = 0; i < 6; ++i) by.brightness[8] += images.settings.velocity[i] * by.brightness[i];
  }
  if (r.seen && !std::isnan(gradients.depth_u) && !std::isnan(gradients.depth_v)) {
    by_twist(gradients.depth_u, gradients.depth_v, at_depth, images.camera, by.depth);
    by.depth[2] -= 1.0f, by.depth[3] -= at_depth.y, by.depth[4] += at_depth.x;
    const float scale = incidence_cosine(gradients, at_depth, images.camera) * at_depth.inverse_z;
    for (Vector& values : by.depth_vectors) values *= scale;
  }
  return by;
}

// The sums over a row of points, in single precision.
struct RowSums {
  Vector claimed[kUnknowns][kVectors], shared[kUnknowns][kVectors];
};

void add_products(const Jacobian& left, const Jacobian& right, const Residuals& r, Vector (*sums)[kVectors]) {
  for (int i = 0; i < kUnknowns; ++i)
    for (int k = 0; k < kVectors; ++k)
      sums[i][k] += r.brightness_weight * left.brightness[i] * right.brightness_vectors[k];
  for (int i = 0; i < 6; ++i)
    for (int k = 0; k < 2; ++k) sums[i][k] += r.depth_weight * left.depth[i] * right.depth_vectors[k];
}

void add_to_cell(const Aligned& images, const Sample& reference, const Sample& frame, const Point& at_depth,
                 const Residuals& r, CellSums& cell) {
  if (r.met) {
    cell.met += 1.0;
    cell.near += std::fabs(frame.depth * at_depth.inverse_z - 1.0f) < images.max_depth_error;
  }
  if (!r.lit) return;
  const double expected = images.settings.gain * reference.brightness + images.settings.bias, found = frame.brightness;
  cell.lit += 1.0;
  cell.expected += expected, cell.found += found;
  cell.expected_squared += expected * expected, cell.found_squared += found * found, cell.product += expected * found;
  cell.difference += std::fabs(r.brightness);
}

void add_point(const Aligned& images, int x, int y, int cell, RowSums& row, EvidenceSums& sums) {
  const Camera& camera = images.camera;
  const Sample reference = reference_at(images, x, y);
  if (!(reference.depth > 0.0f)) return;  // NaN is none
  const float point[3] = {(float(x) - camera.cx) / camera.fx * reference.depth,
                          (float(y) - camera.cy) / camera.fy * reference.depth, reference.depth};
  const Point at_depth = moved(images.depth_motion, point, camera),
              at_color = moved(images.color_motion, point, camera);
  if (!at_depth.inside) return;  // nothing of it is compared
  Sample frame = frame_at(images, at_depth);
  if (at_color.inside && std::memcmp(&images.color_motion, &images.depth_motion, sizeof(Pose)) != 0) {
    const Sample color = frame_at(images, at_color);
    frame.brightness = color.brightness;
    frame.brightness_u = color.brightness_u, frame.brightness_v = color.brightness_v;
  }
  const Residuals r = residuals_of(images, reference, frame, at_color, at_depth);
  const float light = reference.brightness;
  const Jacobian own = jacobian_of(images, frame, 1.0f, light, at_color, at_depth, r);
  const Jacobian shared = jacobian_of(images, reference, images.settings.gain, light, at_color, at_depth, r);
  add_products(own, own, r, row.claimed), add_products(shared, own, r, row.shared);
  for (int i = 0; i < kUnknowns; ++i)
    sums.scores[i][cell] += shared.brightness[i] * (r.brightness_weight * r.brightness);
  for (int i = 0; i < 6; ++i) sums.scores[i][cell] += shared.depth[i] * (r.depth_weight * r.depth);
  add_to_cell(images, reference, frame, at_depth, r, sums.cells[cell]);
}

}  // namespace

void sum_evidence(const Aligned& given, int cell_row, EvidenceSums& sums) {
  const Readout readout(given.readout);
  Aligned images = given;  // as the row that is summed sees it
  const int first = images.step / 2;
  const auto compared = [&](int side) { return (side - first + images.step - 1) / images.step; };
  const int rows = compared(images.camera.height), columns = compared(images.camera.width);
  for (int row = 0; row < rows; ++row) {
    if (row * kCellRows / rows != cell_row) continue;
    const float time = time_of_row(first + row * images.step, images.camera.height);
    images.color_motion = readout.at(given.color_motion, time);
    images.depth_motion = readout.at(given.depth_motion, time);
    RowSums of_row{};
    for (int column = 0; column < columns; ++column)
      add_point(images, first + column * images.step, first + row * images.step, column * kCellColumns / columns,
                of_row, sums);
    for (int i = 0; i < kUnknowns; ++i)
      for (int k = 0; k < kUnknowns; ++k)
        sums.claimed[i][k] += of_row.claimed[i][k / kLane][k % kLane],
            sums.shared[i][k] += of_row.shared[i][k / kLane][k % kLane];
  }
}

}  // namespace splatam
