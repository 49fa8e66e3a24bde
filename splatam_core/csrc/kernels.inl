// Included once per instruction set, inside a namespace and a target region, after lanes.inl.

static inline bool is_usable(float x) { return x > -kHuge && x < kHuge; }  // false for NaN

static inline float clamp(float x, float low, float high) { return x < low ? low : x > high ? high : x; }

static inline TileRect touched_tiles(float u, float v, float extent, const Camera& camera) {
  const float right = float(camera.width - 1), bottom = float(camera.height - 1);
  TileRect rect;
  rect.x0 = std::uint16_t(int(clamp(u - extent, 0.0f, right)) / kTile);
  rect.x1 = std::uint16_t(int(clamp(u + extent, 0.0f, right)) / kTile);
  rect.y0 = std::uint16_t(int(clamp(v - extent, 0.0f, bottom)) / kTile);
  rect.y1 = std::uint16_t(int(clamp(v + extent, 0.0f, bottom)) / kTile);
  rect.missed_corners = 0;
  if (rect.x0 == rect.x1 || rect.y0 == rect.y1) return rect;
  // Distance from the centre to the nearest pixel of the outer columns and rows.
  const float left = clamp(u - float(rect.x0 * kTile + kTile - 1), 0.0f, 1e9f),
              above = clamp(v - float(rect.y0 * kTile + kTile - 1), 0.0f, 1e9f);
  const float past = clamp(float(rect.x1 * kTile) - u, 0.0f, 1e9f),
              below = clamp(float(rect.y1 * kTile) - v, 0.0f, 1e9f);
  const float limit = extent * extent;
  rect.missed_corners =
      std::uint16_t((left * left + above * above > limit) | (past * past + above * above > limit) << 1 |
                    (left * left + below * below > limit) << 2 | (past * past + below * below > limit) << 3);
  return rect;
}

static std::size_t project(const GaussianArrays& gaussians, const Camera& camera, const Pose& pose, std::size_t begin,
                           std::size_t end, Splat* splats, TileRect* rects, std::uint32_t* ids) {
  std::size_t visible = begin;
  const float focal = camera.focal();
  for (std::size_t first = begin; first < end; first += 8) {
    const int count = end - first < 8 ? int(end - first) : 8;
    Lanes x{}, y{}, z{}, log_scale{}, logit{};
    for (int i = 0; i < count; ++i) {
      const float* mean = gaussians.means + 3 * (first + i);
      x[i] = mean[0], y[i] = mean[1], z[i] = mean[2];
      log_scale[i] = gaussians.log_scales[first + i];
      logit[i] = gaussians.logit_opacities[first + i];
    }
    const float *R = pose.R, *t = pose.t;
    const Lanes cam_x = R[0] * x + R[1] * y + R[2] * z + t[0];
    const Lanes cam_y = R[3] * x + R[4] * y + R[5] * z + t[1];
    const Lanes cam_z = R[6] * x + R[7] * y + R[8] * z + t[2];
    const Lanes inverse_z = 1.0f / cam_z;
    const Lanes u = camera.fx * cam_x * inverse_z + camera.cx;
    const Lanes v = camera.fy * cam_y * inverse_z + camera.cy;
    const Lanes sigma = focal * exp(min(log_scale, splat(40.0f))) * inverse_z;
    const Lanes variance = sigma * sigma + kBlur;
    const Lanes opacity = 1.0f / (1.0f + exp(min(-logit, splat(80.0f))));
    const Lanes extent = sqrt(max(2.0f * variance * log_bound(255.0f * opacity), Lanes{}));
    // Comparisons with NaN are false, so that what is not finite is not drawn.
    const IntLanes drawn = (cam_z > kNear) & (cam_z < kHuge) & (absolute(log_scale) < kHuge) &
                           (absolute(logit) < kHuge) & (opacity >= kMinAlpha) & (u + extent >= 0.0f) &
                           (u - extent <= float(camera.width - 1)) & (v + extent >= 0.0f) &
                           (v - extent <= float(camera.height - 1));
    for (int i = 0; i < count; ++i) {
      if (!drawn[i]) continue;
      const float* rgb = gaussians.rgb + 3 * (first + i);
      if (!(is_usable(rgb[0]) && is_usable(rgb[1]) && is_usable(rgb[2]))) continue;
      splats[visible] = {u[i], v[i], -0.5f / variance[i], opacity[i], rgb[0], rgb[1], rgb[2], cam_z[i]};
      rects[visible] = touched_tiles(u[i], v[i], extent[i], camera);
      ids[visible] = std::uint32_t(first + i);
      ++visible;
    }
  }
  return visible - begin;
}

// A splat within one tile: its offsets, and the two separable factors of its alpha (per column, per row).
struct Footprint {
  Lanes dx, across;
  float dy[8], down[8];
};

static inline Footprint footprint(const Splat& s, const TileList& tile) {
  Footprint f;
  f.dx = iota() + (float(tile.x) - s.u);
  const Lanes dy = iota() + (float(tile.y) - s.v);
  f.across = exp(f.dx * f.dx * s.falloff);
  store(f.dy, dy);
  store(f.down, s.opacity * exp(dy * dy * s.falloff));
  return f;
}

// Returns a mask of the lanes of a tile's row that are inside the image.
static inline IntLanes on_image(const TileList& tile, const Camera& camera, int row) {
  const float columns = tile.y + row < camera.height ? float(camera.width - tile.x) : 0.0f;
  return iota() < columns;
}

constexpr int kPairs = kTile / 2;

// Returns whether every pixel of a tile is saturated. Rows is Pixels or PixelGradients. Call it at least every 16
// splats: it also resets the transmittance of saturated pixels, before that becomes a denormal number.
template <typename Rows>
static inline bool opaque(Rows* rows) {
  IntPair open{};
  for (int i = 0; i < kPairs; ++i) {
    const IntPair more = rows[i].T >= kMinTransmittance;
    rows[i].T = either(more, rows[i].T, Pair{} + 0.5f * kMinTransmittance);
    open |= more;
  }
  return !any(open);
}

static inline Lanes load_row(const float* plane, const TileList& tile, const Camera& camera, int row) {
  float values[8] = {};
  const int columns = camera.width - tile.x < 8 ? camera.width - tile.x : 8;
  if (tile.y + row < camera.height)
    __builtin_memcpy(values, plane + std::size_t(tile.y + row) * camera.width + tile.x, sizeof(float) * columns);
  return load(values);
}

static inline void store_row(float* plane, const TileList& tile, const Camera& camera, int row, Lanes value) {
  if (tile.y + row >= camera.height) return;
  const int columns = camera.width - tile.x < 8 ? camera.width - tile.x : 8;
  float values[8];
  store(values, value);
  __builtin_memcpy(plane + std::size_t(tile.y + row) * camera.width + tile.x, values, sizeof(float) * columns);
}

static inline Pair load_rows(const float* plane, const TileList& tile, const Camera& camera, int row) {
  return pair(load_row(plane, tile, camera, row), load_row(plane, tile, camera, row + 1));
}

static inline void store_rows(float* plane, const TileList& tile, const Camera& camera, int row, Pair values) {
  store_row(plane, tile, camera, row, upper(values));
  store_row(plane, tile, camera, row + 1, lower(values));
}

static inline Pair first_transmittance(const TileList& tile, const Camera& camera, int row) {
  return pair(keep(on_image(tile, camera, row), splat(1.0f)), keep(on_image(tile, camera, row + 1), splat(1.0f)));
}

struct Pixels {  // two rows being blended
  Pair T, r, g, b, depth, silhouette;
};

static inline void start(Pixels* pixels, const TileList& tile, const Camera& camera) {
  for (int i = 0; i < kPairs; ++i) {
    pixels[i] = Pixels{};
    pixels[i].T = first_transmittance(tile, camera, 2 * i);
  }
}

static inline void blend(Pixels& pixels, Pair raw_alpha, const Splat& s) {
  const Pair alpha = keep(raw_alpha >= kMinAlpha, min(raw_alpha, kMaxAlpha));
  const Pair w = keep(pixels.T >= kMinTransmittance, alpha * pixels.T);
  pixels.r += w * s.r;
  pixels.g += w * s.g;
  pixels.b += w * s.b;
  pixels.depth += w * s.z;
  pixels.silhouette += w;
  pixels.T *= 1.0f - alpha;  // also in saturated pixels: the shortest path to the next splat's T
}

// Returns a splat's alpha in two rows, before it is clamped.
static inline Pair raw_alpha(const Footprint& f, int row) {
  return pair(f.down[row], f.down[row + 1]) * pair(f.across, f.across);
}

constexpr std::size_t kBatch = 16;

// Blends up to kBatch splats into a tile, pair of rows by pair, so that the pixels stay in registers. Pairs that a
// splat does not reach are not skipped: mispredicted branches cost more than blending zeros.
static inline void blend(Pixels* pixels, const Splat* batch, const Footprint* footprints, std::size_t size) {
  for (int i = 0; i < kPairs; ++i) {
    Pixels rows = pixels[i];
    for (std::size_t k = 0; k < size; ++k) blend(rows, raw_alpha(footprints[k], 2 * i), batch[k]);
    pixels[i] = rows;
  }
}

static void forward(const TileList& tile, const Splat* splats, const Camera& camera, const Images& images) {
  const std::size_t plane = std::size_t(camera.width) * camera.height;
  Pixels pixels[kPairs];
  start(pixels, tile, camera);
  Splat batch[kBatch];
  Footprint footprints[kBatch];
  for (std::size_t first = 0; first < tile.count && !opaque(pixels); first += kBatch) {
    const std::size_t size = tile.count - first < kBatch ? tile.count - first : kBatch;
    for (std::size_t k = 0; k < size; ++k) {
      batch[k] = splats[tile.splats[first + k]];
      footprints[k] = footprint(batch[k], tile);
    }
    blend(pixels, batch, footprints, size);
  }
  for (int i = 0; i < kPairs; ++i) {
    store_rows(images.rgb, tile, camera, 2 * i, pixels[i].r);
    store_rows(images.rgb + plane, tile, camera, 2 * i, pixels[i].g);
    store_rows(images.rgb + 2 * plane, tile, camera, 2 * i, pixels[i].b);
    store_rows(images.depth, tile, camera, 2 * i, pixels[i].depth);
    store_rows(images.silhouette, tile, camera, 2 * i, pixels[i].silhouette);
  }
}

// Two rows in the backward pass, which also goes front to back.
struct PixelGradients {
  Pair T, Q;                        // transmittance; the part of sum_k w_k q_k that is still to come, see blend_back()
  Pair r, g, b, depth, silhouette;  // gradients of the loss by the pixel's values
};

// The backward pass of one splat. With q_k = sum over channels of (gradient of the channel times value of splat k),
// dL/dalpha_k = T_k q_k - Q / (1 - alpha_k).
template <bool kMap>
static inline void blend_back(PixelGradients* rows, const Splat& s, const Footprint& f, SplatGradient& gradient) {
  Pair by_alpha{}, by_y{}, by_y_squared{}, by_r{}, by_g{}, by_b{}, by_z{};
  for (int i = 0; i < kPairs; ++i) {
    PixelGradients& at = rows[i];
    const Pair raw = raw_alpha(f, 2 * i), dy = pair(f.dy[2 * i], f.dy[2 * i + 1]);
    const Pair alpha = keep(raw >= kMinAlpha, min(raw, kMaxAlpha));
    const IntPair takes = at.T >= kMinTransmittance;
    const Pair w = keep(takes, alpha * at.T), left = 1.0f - alpha;
    const Pair q = at.r * s.r + at.g * s.g + at.b * s.b + at.depth * s.z + at.silhouette;
    at.Q -= w * q;
    const Pair gradient_by_log_alpha = keep(takes & (raw <= kMaxAlpha), alpha * (at.T * q - at.Q / left));
    by_alpha += gradient_by_log_alpha;
    by_y += gradient_by_log_alpha * dy;
    by_y_squared += gradient_by_log_alpha * dy * dy;
    if (kMap) {
      by_r += w * at.r;
      by_g += w * at.g;
      by_b += w * at.b;
    }
    by_z += w * at.depth;
    at.T *= left;
  }
  const auto folded = [](Pair rows) { return upper(rows) + lower(rows); };
  const Lanes by_column = folded(by_alpha), by_x = by_column * f.dx;
  const Lanes sums[8] = {by_column,    by_x,         folded(by_y), by_x * f.dx + folded(by_y_squared),
                         folded(by_r), folded(by_g), folded(by_b), folded(by_z)};  // as in SplatGradient
  float* into = &gradient.log_alpha;
  store(into, load(into) + row_sums(sums));
}

template <bool kMap>
static inline void backward_tile(const TileList& tile, const Splat* splats, const Camera& camera,
                                 const ConstImages& drawn, const ConstImages& gradient, SplatGradient* gradients) {
  const std::size_t plane = std::size_t(camera.width) * camera.height;
  PixelGradients rows[kPairs];
  for (int i = 0; i < kPairs; ++i) {
    const auto load = [&](const float* image) { return load_rows(image, tile, camera, 2 * i); };
    PixelGradients& at = rows[i];
    at.T = first_transmittance(tile, camera, 2 * i);
    at.r = load(gradient.rgb), at.g = load(gradient.rgb + plane), at.b = load(gradient.rgb + 2 * plane);
    at.depth = load(gradient.depth), at.silhouette = load(gradient.silhouette);
    at.Q = at.r * load(drawn.rgb) + at.g * load(drawn.rgb + plane) + at.b * load(drawn.rgb + 2 * plane) +
           at.depth * load(drawn.depth) + at.silhouette * load(drawn.silhouette);
  }
  for (std::size_t k = 0; k < tile.count; ++k) {
    if (k % 8 == 7 && opaque(rows)) break;
    const Splat& s = splats[tile.splats[k]];
    blend_back<kMap>(rows, s, footprint(s, tile), gradients[tile.splats[k]]);
  }
}

static void backward(const TileList& tile, const Splat* splats, const Camera& camera, const ConstImages& drawn,
                     const ConstImages& gradient, bool map, SplatGradient* gradients) {
  if (map)
    backward_tile<true>(tile, splats, camera, drawn, gradient, gradients);
  else
    backward_tile<false>(tile, splats, camera, drawn, gradient, gradients);
}

static_assert(sizeof(Footprint) == kFloatsPerFootprint * sizeof(float), "scratch is allocated elsewhere");

static inline Lanes load_bytes(const std::uint8_t* pixels, int columns, int channel) {
  Lanes values{};
  for (int i = 0; i < columns; ++i) values[i] = float(pixels[3 * i + channel]);
  return values * (1.0f / 255.0f);
}

// Huber's loss of one row, its gradient by the pixel values, and Q of blend_back() before the first splat.
struct Comparison {
  Lanes r, g, b, depth, Q;
  double loss;
};

// Gradient of Huber's loss: linear up to the limit, constant beyond.
static inline Lanes huber_gradient(Lanes residual, float limit) {
  const Lanes gradient = residual * (1.0f / limit);
  return max(min(gradient, splat(1.0f)), splat(-1.0f));
}

static inline Lanes huber_loss(Lanes residual, Lanes gradient, float limit) {
  return gradient * (residual - 0.5f * limit * gradient);
}

static inline Comparison compare(Lanes r, Lanes g, Lanes b, Lanes depth, const TileList& tile, const Camera& camera,
                                 int row, const Target& target) {
  Comparison result{};
  if (tile.y + row >= camera.height) return result;
  const int columns = camera.width - tile.x < 8 ? camera.width - tile.x : 8;
  const std::size_t at = std::size_t(tile.y + row) * camera.width + tile.x;
  const IntLanes real = iota() < float(columns);
  Lanes reading{};
  __builtin_memcpy(&reading, target.depth + at, sizeof(float) * columns);
  const std::uint8_t* colors = target.rgb + 3 * at;
  const Lanes red = keep(real, r - load_bytes(colors, columns, 0)), by_r = huber_gradient(red, target.color_limit);
  const Lanes green = keep(real, g - load_bytes(colors, columns, 1)), by_g = huber_gradient(green, target.color_limit);
  const Lanes blue = keep(real, b - load_bytes(colors, columns, 2)), by_b = huber_gradient(blue, target.color_limit);
  const Lanes range = keep(real & (reading > 0.0f), depth - reading),
              by_range = huber_gradient(range, target.depth_limit);
  const Lanes loss =
      target.color_weight * (huber_loss(red, by_r, target.color_limit) + huber_loss(green, by_g, target.color_limit) +
                             huber_loss(blue, by_b, target.color_limit)) +
      target.depth_weight * huber_loss(range, by_range, target.depth_limit);
  for (int i = 0; i < 8; ++i) result.loss += loss[i];
  result.r = target.color_weight * by_r, result.g = target.color_weight * by_g, result.b = target.color_weight * by_b;
  result.depth = target.depth_weight * by_range;
  result.Q = result.r * r + result.g * g + result.b * b + result.depth * depth;
  return result;
}

// Starts the backward pass of two rows: compares them with the target. Returns their loss.
static inline double start(PixelGradients& rows, const Pixels& drawn, const TileList& tile, const Camera& camera,
                           int row, const Target& target) {
  const Comparison a =
      compare(upper(drawn.r), upper(drawn.g), upper(drawn.b), upper(drawn.depth), tile, camera, row, target);
  const Comparison b =
      compare(lower(drawn.r), lower(drawn.g), lower(drawn.b), lower(drawn.depth), tile, camera, row + 1, target);
  rows = {first_transmittance(tile, camera, row),
          pair(a.Q, b.Q),
          pair(a.r, b.r),
          pair(a.g, b.g),
          pair(a.b, b.b),
          pair(a.depth, b.depth),
          Pair{}};
  return a.loss + b.loss;
}

static double fit(const TileList& tile, const Splat* splats, const Camera& camera, const Target& target, float* scratch,
                  SplatGradient* gradients) {
  Footprint* footprints = reinterpret_cast<Footprint*>(scratch);
  Pixels pixels[kPairs];
  start(pixels, tile, camera);
  Splat batch[kBatch];
  std::size_t count = 0;
  while (count < tile.count && !opaque(pixels)) {
    const std::size_t size = tile.count - count < kBatch ? tile.count - count : kBatch;
    for (std::size_t k = 0; k < size; ++k) {
      batch[k] = splats[tile.splats[count + k]];
      footprints[count + k] = footprint(batch[k], tile);
    }
    blend(pixels, batch, footprints + count, size);
    count += size;
  }
  double loss = 0.0;
  PixelGradients rows[kPairs];
  for (int i = 0; i < kPairs; ++i) loss += start(rows[i], pixels[i], tile, camera, 2 * i, target);
  for (std::size_t k = 0; k < count; ++k)
    blend_back<true>(rows, splats[tile.splats[k]], footprints[k], gradients[tile.splats[k]]);
  return loss;
}

constexpr float kBeta1 = 0.9f, kBeta2 = 0.99f, kEpsilon = 1e-15f;

static void update(const Splat* splats, const std::uint32_t* ids, const SplatGradient* gradients, std::size_t begin,
                   std::size_t end, const Camera& camera, const Pose& pose, const MutableGaussians& gaussians,
                   const AdamState& adam, const AdamRates& rates, float* bounds) {
  float left1[256], left2[256];  // Adam's bias corrections: 1 minus these
  left1[0] = left2[0] = 1.0f;
  for (int i = 1; i < 256; ++i) left1[i] = left1[i - 1] * kBeta1, left2[i] = left2[i - 1] * kBeta2;
  const Lanes rate = {rates.means,           rates.means, rates.means, rates.log_scales,
                      rates.logit_opacities, rates.rgb,   rates.rgb,   rates.rgb};
  for (std::size_t splat_index = begin; splat_index < end; ++splat_index) {
    const SplatGradient& g = gradients[splat_index];
    if (g.log_alpha == 0.0f && g.r == 0.0f && g.g == 0.0f && g.b == 0.0f && g.z == 0.0f) continue;
    const std::size_t id = ids[splat_index];
    const GaussianGradient by_gaussian = through_projection(splats[splat_index], g, camera);
    const float *R = pose.R, *d = by_gaussian.camera;
    const Lanes gradient = {R[0] * d[0] + R[3] * d[1] + R[6] * d[2],
                            R[1] * d[0] + R[4] * d[1] + R[7] * d[2],
                            R[2] * d[0] + R[5] * d[1] + R[8] * d[2],
                            by_gaussian.log_scale,
                            by_gaussian.logit_opacity,
                            g.r,
                            g.g,
                            g.b};
    float* moments = adam.moments + 16 * id;
    const Lanes first = kBeta1 * load(moments) + (1.0f - kBeta1) * gradient;
    const Lanes second = kBeta2 * load(moments + 8) + (1.0f - kBeta2) * gradient * gradient;
    const int step = adam.steps[id] < 255 ? adam.steps[id] + 1 : 255;
    const Lanes move = rate * (first / (1.0f - left1[step])) / (sqrt(second / (1.0f - left2[step])) + kEpsilon);
    const IntLanes usable = (absolute(first) < kHuge) & (second < kHuge) & (absolute(move) < kHuge);
    if (count(usable) < 8) continue;  // an overflow would stay in the moments for ever
    store(moments, first);
    store(moments + 8, second);
    adam.steps[id] = std::uint8_t(step);
    float* mean = gaussians.means + 3 * id;
    float* rgb = gaussians.rgb + 3 * id;
    for (int axis = 0; axis < 3; ++axis) {
      mean[axis] -= move[axis];
      rgb[axis] -= move[5 + axis];
      if (bounds) {
        if (mean[axis] < bounds[axis]) bounds[axis] = mean[axis];
        if (mean[axis] > bounds[3 + axis]) bounds[3 + axis] = mean[axis];
      }
    }
    gaussians.log_scales[id] -= move[3];
    gaussians.logit_opacities[id] -= move[4];
    if (bounds && gaussians.log_scales[id] > bounds[6]) bounds[6] = gaussians.log_scales[id];
  }
}

static constexpr Kernels table(const char* name) { return {project, forward, backward, fit, update, align, name}; }
