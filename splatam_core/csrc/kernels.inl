// Included once per instruction set, inside a namespace and a target region, after lanes.inl.

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
  const float left = clamp(u - float(rect.x0 * kTile + kTile - 1), 0.0f, 1e9f), above = clamp(v - float(rect.y0 * kTile + kTile - 1), 0.0f, 1e9f);
  const float past = clamp(float(rect.x1 * kTile) - u, 0.0f, 1e9f), below = clamp(float(rect.y1 * kTile) - v, 0.0f, 1e9f);
  const float limit = extent * extent;
  rect.missed_corners = std::uint16_t((left * left + above * above > limit) | (past * past + above * above > limit) << 1 |
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
    const IntLanes drawn = (cam_z > kNear) & (opacity >= kMinAlpha) & (u + extent >= 0.0f) &
                           (u - extent <= float(camera.width - 1)) & (v + extent >= 0.0f) &
                           (v - extent <= float(camera.height - 1));
    for (int i = 0; i < count; ++i) {
      if (!drawn[i]) continue;
      const float* rgb = gaussians.rgb + 3 * (first + i);
      splats[visible] = {u[i], v[i], -0.5f / variance[i], opacity[i], rgb[0], rgb[1], rgb[2], cam_z[i]};
      rects[visible] = touched_tiles(u[i], v[i], extent[i], camera);
      ids[visible] = std::uint32_t(first + i);
      ++visible;
    }
  }
  return visible - begin;
}

// What a splat is to one tile: dx per column, and both separable factors of its alpha.
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

// Lanes of a tile's row that lie on the image.
static inline IntLanes on_image(const TileList& tile, const Camera& camera, int row) {
  const float columns = tile.y + row < camera.height ? float(camera.width - tile.x) : 0.0f;
  return iota() < columns;
}

static inline bool opaque(const Lanes* transmittance) {
  IntLanes open{};
  for (int row = 0; row < kTile; ++row) open |= transmittance[row] >= kMinTransmittance;
  std::int32_t any = 0;
  for (int i = 0; i < 8; ++i) any |= open[i];
  return !any;
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

static inline void start_transmittance(Lanes* transmittance, const TileList& tile, const Camera& camera) {
  for (int row = 0; row < kTile; ++row) transmittance[row] = keep(on_image(tile, camera, row), splat(1.0f));
}

struct Row {  // eight pixels being blended
  Lanes T, r, g, b, depth, silhouette;
};

static inline void blend(Row& row, Lanes raw_alpha, const Splat& s) {
  const Lanes alpha = min(raw_alpha, splat(kMaxAlpha));
  const Lanes w = keep((alpha >= kMinAlpha) & (row.T >= kMinTransmittance), alpha * row.T);
  row.r += w * s.r;
  row.g += w * s.g;
  row.b += w * s.b;
  row.depth += w * s.z;
  row.silhouette += w;
  row.T -= w;
}

static inline bool opaque(const Row* rows) {
  Lanes T[kTile];
  for (int row = 0; row < kTile; ++row) T[row] = rows[row].T;
  return opaque(T);
}

// Splats are taken in batches, two rows at a time: the pixels stay in registers, and while one row's transmittance
// waits for its last splat, the other's moves on.
static void forward(const TileList& tile, const Splat* splats, const Camera& camera, const Images& images) {
  constexpr std::size_t kBatch = 16;
  const std::size_t plane = std::size_t(camera.width) * camera.height;
  Row rows[kTile] = {};
  for (int row = 0; row < kTile; ++row) rows[row].T = keep(on_image(tile, camera, row), splat(1.0f));
  Splat batch[kBatch];
  Footprint prints[kBatch];
  for (std::size_t first = 0; first < tile.count && !opaque(rows); first += kBatch) {
    const std::size_t size = tile.count - first < kBatch ? tile.count - first : kBatch;
    for (std::size_t i = 0; i < size; ++i) {
      batch[i] = splats[tile.splats[first + i]];
      prints[i] = footprint(batch[i], tile);
    }
    for (int row = 0; row < kTile; row += 2) {
      Row upper = rows[row], lower = rows[row + 1];
      for (std::size_t i = 0; i < size; ++i) {
        const Footprint& f = prints[i];
        if ((f.down[row] < kMinAlpha) & (f.down[row + 1] < kMinAlpha)) continue;
        blend(upper, f.down[row] * f.across, batch[i]);
        blend(lower, f.down[row + 1] * f.across, batch[i]);
      }
      rows[row] = upper;
      rows[row + 1] = lower;
    }
  }
  for (int row = 0; row < kTile; ++row) {
    store_row(images.rgb, tile, camera, row, rows[row].r);
    store_row(images.rgb + plane, tile, camera, row, rows[row].g);
    store_row(images.rgb + 2 * plane, tile, camera, row, rows[row].b);
    store_row(images.depth, tile, camera, row, rows[row].depth);
    store_row(images.silhouette, tile, camera, row, rows[row].silhouette);
  }
}

// Front to back again. With q_k = sum over channels of (gradient times what k adds) and Q what is still to come of
// sum_k w_k q_k, the whole backward pass is dL/dalpha_k = T_k q_k - Q / (1 - alpha_k).
template <bool kMap>
static inline void backward_tile(const TileList& tile, const Splat* splats, const Camera& camera,
                                 const ConstImages& drawn, const ConstImages& gradient, SplatGradient* gradients) {
  const std::size_t plane = std::size_t(camera.width) * camera.height;
  Lanes T[kTile], Q[kTile], gr[kTile], gg[kTile], gb[kTile], gd[kTile], gs[kTile];
  start_transmittance(T, tile, camera);
  for (int row = 0; row < kTile; ++row) {
    gr[row] = load_row(gradient.rgb, tile, camera, row);
    gg[row] = load_row(gradient.rgb + plane, tile, camera, row);
    gb[row] = load_row(gradient.rgb + 2 * plane, tile, camera, row);
    gd[row] = load_row(gradient.depth, tile, camera, row);
    gs[row] = load_row(gradient.silhouette, tile, camera, row);
    Q[row] = gr[row] * load_row(drawn.rgb, tile, camera, row) + gg[row] * load_row(drawn.rgb + plane, tile, camera, row) +
             gb[row] * load_row(drawn.rgb + 2 * plane, tile, camera, row) +
             gd[row] * load_row(drawn.depth, tile, camera, row) + gs[row] * load_row(drawn.silhouette, tile, camera, row);
  }
  for (std::size_t i = 0; i < tile.count; ++i) {
    if (i % 8 == 7 && opaque(T)) break;
    const Splat& s = splats[tile.splats[i]];
    const Footprint f = footprint(s, tile);
    Lanes sums[8] = {};  // as in SplatGradient
    Lanes squared_dy{};
    for (int row = 0; row < kTile; ++row) {
      if (f.down[row] < kMinAlpha) continue;
      const Lanes raw = f.down[row] * f.across;
      const Lanes alpha = min(raw, splat(kMaxAlpha));
      const IntLanes blended = (alpha >= kMinAlpha) & (T[row] >= kMinTransmittance);
      const Lanes w = keep(blended, alpha * T[row]);
      const Lanes q = gr[row] * s.r + gg[row] * s.g + gb[row] * s.b + gd[row] * s.z + gs[row];
      Q[row] -= w * q;
      const Lanes slope = keep(blended & (raw <= kMaxAlpha), alpha * (T[row] * q - Q[row] / (1.0f - alpha)));
      const Lanes slope_dy = slope * f.dy[row];
      sums[0] += slope;
      sums[2] += slope_dy;
      squared_dy += slope_dy * f.dy[row];
      if (kMap) {
        sums[4] += w * gr[row];
        sums[5] += w * gg[row];
        sums[6] += w * gb[row];
      }
      sums[7] += w * gd[row];
      T[row] -= w;
    }
    sums[1] = sums[0] * f.dx;
    sums[3] = sums[1] * f.dx + squared_dy;
    float* into = &gradients[tile.splats[i]].log_alpha;
    store(into, load(into) + row_sums(sums));
  }
}

static void backward(const TileList& tile, const Splat* splats, const Camera& camera, const ConstImages& drawn,
                     const ConstImages& gradient, bool map, SplatGradient* gradients) {
  if (map)
    backward_tile<true>(tile, splats, camera, drawn, gradient, gradients);
  else
    backward_tile<false>(tile, splats, camera, drawn, gradient, gradients);
}

static_assert(sizeof(Footprint) == kFloatsPerPrint * sizeof(float), "scratch is allocated elsewhere");

static inline Lanes load_bytes(const std::uint8_t* pixels, int columns, int channel) {
  Lanes values{};
  for (int i = 0; i < columns; ++i) values[i] = float(pixels[3 * i + channel]);
  return values * (1.0f / 255.0f);
}

static inline Lanes sign(Lanes x) { return x > 0.0f ? splat(1.0f) : x < 0.0f ? splat(-1.0f) : Lanes{}; }

struct RowGradient {
  Lanes r, g, b, depth;
};

// L1 of one row, its gradient, and what the gradient sums to over the row's splats (Q of backward_tile).
static inline double compare(const Row& drawn, const TileList& tile, const Camera& camera, int row, const Target& target,
                             RowGradient& gradient, Lanes& Q) {
  gradient = RowGradient{};
  Q = Lanes{};
  if (tile.y + row >= camera.height) return 0.0;
  const int columns = camera.width - tile.x < 8 ? camera.width - tile.x : 8;
  const std::size_t at = std::size_t(tile.y + row) * camera.width + tile.x;
  const IntLanes real = iota() < float(columns);
  Lanes depth{};
  __builtin_memcpy(&depth, target.depth + at, sizeof(float) * columns);
  const Lanes red = keep(real, drawn.r - load_bytes(target.rgb + 3 * at, columns, 0));
  const Lanes green = keep(real, drawn.g - load_bytes(target.rgb + 3 * at, columns, 1));
  const Lanes blue = keep(real, drawn.b - load_bytes(target.rgb + 3 * at, columns, 2));
  const Lanes range = keep(real & (depth > 0.0f), drawn.depth - depth);
  gradient.r = target.color_weight * sign(red);
  gradient.g = target.color_weight * sign(green);
  gradient.b = target.color_weight * sign(blue);
  gradient.depth = target.depth_weight * sign(range);
  Q = gradient.r * drawn.r + gradient.g * drawn.g + gradient.b * drawn.b + gradient.depth * drawn.depth;
  const Lanes loss = gradient.r * red + gradient.g * green + gradient.b * blue + gradient.depth * range;
  double total = 0.0;
  for (int i = 0; i < 8; ++i) total += loss[i];
  return total;
}

static double fit(const TileList& tile, const Splat* splats, const Camera& camera, const Target& target, float* scratch,
                  SplatGradient* gradients) {
  constexpr std::size_t kBatch = 16;
  Footprint* prints = reinterpret_cast<Footprint*>(scratch);
  Row rows[kTile] = {};
  for (int row = 0; row < kTile; ++row) rows[row].T = keep(on_image(tile, camera, row), splat(1.0f));
  Splat batch[kBatch];
  std::size_t count = 0;
  while (count < tile.count && !opaque(rows)) {
    const std::size_t size = tile.count - count < kBatch ? tile.count - count : kBatch;
    for (std::size_t i = 0; i < size; ++i) {
      batch[i] = splats[tile.splats[count + i]];
      prints[count + i] = footprint(batch[i], tile);
    }
    for (int row = 0; row < kTile; row += 2) {
      Row upper = rows[row], lower = rows[row + 1];
      for (std::size_t i = 0; i < size; ++i) {
        const Footprint& f = prints[count + i];
        if ((f.down[row] < kMinAlpha) & (f.down[row + 1] < kMinAlpha)) continue;
        blend(upper, f.down[row] * f.across, batch[i]);
        blend(lower, f.down[row + 1] * f.across, batch[i]);
      }
      rows[row] = upper;
      rows[row + 1] = lower;
    }
    count += size;
  }
  double loss = 0.0;
  Lanes T[kTile], Q[kTile];
  RowGradient gradient[kTile];
  for (int row = 0; row < kTile; ++row) loss += compare(rows[row], tile, camera, row, target, gradient[row], Q[row]);
  start_transmittance(T, tile, camera);
  for (std::size_t k = 0; k < count; ++k) {
    const Splat& s = splats[tile.splats[k]];
    const Footprint& f = prints[k];
    Lanes sums[8] = {};  // as in SplatGradient
    Lanes squared_dy{};
    for (int row = 0; row < kTile; ++row) {
      if (f.down[row] < kMinAlpha) continue;
      const RowGradient& g = gradient[row];
      const Lanes raw = f.down[row] * f.across;
      const Lanes alpha = min(raw, splat(kMaxAlpha));
      const IntLanes blended = (alpha >= kMinAlpha) & (T[row] >= kMinTransmittance);
      const Lanes w = keep(blended, alpha * T[row]);
      const Lanes q = g.r * s.r + g.g * s.g + g.b * s.b + g.depth * s.z;
      Q[row] -= w * q;
      const Lanes slope = keep(blended & (raw <= kMaxAlpha), alpha * (T[row] * q - Q[row] / (1.0f - alpha)));
      const Lanes slope_dy = slope * f.dy[row];
      sums[0] += slope;
      sums[2] += slope_dy;
      squared_dy += slope_dy * f.dy[row];
      sums[4] += w * g.r;
      sums[5] += w * g.g;
      sums[6] += w * g.b;
      sums[7] += w * g.depth;
      T[row] -= w;
    }
    sums[1] = sums[0] * f.dx;
    sums[3] = sums[1] * f.dx + squared_dy;
    float* into = &gradients[tile.splats[k]].log_alpha;
    store(into, load(into) + row_sums(sums));
  }
  return loss;
}

constexpr float kBeta1 = 0.9f, kBeta2 = 0.999f, kEpsilon = 1e-15f;

static void update(const Splat* splats, const std::uint32_t* ids, const SplatGradient* gradients, std::size_t begin,
                   std::size_t end, const Camera& camera, const Pose& pose, const MutableGaussians& gaussians,
                   const AdamState& adam, const AdamRates& rates, float* bounds) {
  float left1[256], left2[256];  // what bias correction divides by
  left1[0] = left2[0] = 1.0f;
  for (int i = 1; i < 256; ++i) left1[i] = left1[i - 1] * kBeta1, left2[i] = left2[i - 1] * kBeta2;
  const Lanes rate = {rates.means, rates.means, rates.means, rates.log_scales, rates.logit_opacities,
                      rates.rgb,   rates.rgb,   rates.rgb};
  for (std::size_t splat_index = begin; splat_index < end; ++splat_index) {
    const SplatGradient& g = gradients[splat_index];
    if (g.log_alpha == 0.0f && g.r == 0.0f && g.g == 0.0f && g.b == 0.0f && g.z == 0.0f) continue;
    const std::size_t id = ids[splat_index];
    const GaussianGradient slope = through_projection(splats[splat_index], g, camera);
    const float *R = pose.R, *d = slope.camera;
    const Lanes gradient = {R[0] * d[0] + R[3] * d[1] + R[6] * d[2],
                            R[1] * d[0] + R[4] * d[1] + R[7] * d[2],
                            R[2] * d[0] + R[5] * d[1] + R[8] * d[2],
                            slope.log_scale, slope.logit_opacity, g.r, g.g, g.b};
    float* moments = adam.moments + 16 * id;
    const Lanes first = kBeta1 * load(moments) + (1.0f - kBeta1) * gradient;
    const Lanes second = kBeta2 * load(moments + 8) + (1.0f - kBeta2) * gradient * gradient;
    store(moments, first);
    store(moments + 8, second);
    const int step = adam.steps[id] < 255 ? ++adam.steps[id] : 255;
    const Lanes move = rate * (first / (1.0f - left1[step])) / (sqrt(second / (1.0f - left2[step])) + kEpsilon);
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

static constexpr Kernels table(const char* name) {
  return {project, forward, backward, fit, update, align, name};
}
