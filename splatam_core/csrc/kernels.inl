// Included once per instruction set, inside a namespace and a target region, after projection.inl and lanes.inl.

// Loads up to eight times three values: a lane each, three vectors. The lanes beyond are zero.
static inline void load_triples(const float* from, int count, Lanes* to) {
  if (count == 8) return load_triples(from, to);
  float values[24] = {};
  for (int i = 0; i < 3 * count; ++i) values[i] = from[i];
  load_triples(values, to);
}

static inline Lanes clamp(Lanes x, float low, float high) { return min(max(x, splat(low)), splat(high)); }

// Eight TileRects, each as two numbers.
struct TileRects {
  static_assert(sizeof(TileRect) == 8 && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "of 16 bits, the lower first");
  std::int32_t first[8], last[8];
  TileRect operator[](int i) const {
    const std::int32_t both[2] = {first[i], last[i]};
    TileRect rect;
    __builtin_memcpy(&rect, both, sizeof rect);
    return rect;
  }
};

static inline TileRects touched_tiles(Lanes u, Lanes v, Lanes extent, const Camera& camera) {
  static_assert(kTile == 8, "a shift by three divides by it");
  const float right = float(camera.width - 1), bottom = float(camera.height - 1);
  const IntLanes x0 = truncated(clamp(u - extent, 0.0f, right)) >> 3;
  const IntLanes x1 = truncated(clamp(u + extent, 0.0f, right)) >> 3;
  const IntLanes y0 = truncated(clamp(v - extent, 0.0f, bottom)) >> 3;
  const IntLanes y1 = truncated(clamp(v + extent, 0.0f, bottom)) >> 3;
  // Distance from the centre to the nearest pixel of the outer columns and rows.
  const Lanes left = clamp(u - to_float((x0 << 3) + (kTile - 1)), 0.0f, 1e9f);
  const Lanes above = clamp(v - to_float((y0 << 3) + (kTile - 1)), 0.0f, 1e9f);
  const Lanes past = clamp(to_float(x1 << 3) - u, 0.0f, 1e9f), below = clamp(to_float(y1 << 3) - v, 0.0f, 1e9f);
  const Lanes limit = extent * extent;
  const IntLanes missed = ((left * left + above * above > limit) & 1) | ((past * past + above * above > limit) & 2) |
                          ((left * left + below * below > limit) & 4) | ((past * past + below * below > limit) & 8);
  TileRects rects;
  const IntLanes counts = (x0 < x1) & (y0 < y1);  // else a missed corner would be all of a row
  store(rects.first, x0 | (y0 << 16));
  store(rects.last, x1 | (y1 << 16) | ((missed & counts) << 28));
  return rects;
}

static std::size_t project(const GaussianArrays& gaussians, const Camera& camera, const Pose& pose, std::size_t begin,
                           std::size_t end, Splat* splats, TileRect* rects, std::uint32_t* ids) {
  std::size_t visible = begin;
  const float focal = camera.focal();
  for (std::size_t first = begin; first < end; first += 8) {
    const int count = end - first < 8 ? int(end - first) : 8;
    Lanes means[3], rgb[3];
    load_triples(gaussians.means + 3 * first, count, means);
    const Lanes x = means[0], y = means[1], z = means[2];
    const Lanes log_scale = load_some(gaussians.log_scales + first, count, Lanes{});
    const Lanes logit = load_some(gaussians.logit_opacities + first, count, Lanes{});
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
    IntLanes drawn = (cam_z > kNear) & (cam_z < kHuge) & (absolute(log_scale) < kHuge) & (absolute(logit) < kHuge) &
                     (opacity >= kMinAlpha) & (u + extent >= 0.0f) & (u - extent <= float(camera.width - 1)) &
                     (v + extent >= 0.0f) & (v - extent <= float(camera.height - 1));
    if (!any(drawn)) continue;
    load_triples(gaussians.rgb + 3 * first, count, rgb);
    for (int channel = 0; channel < 3; ++channel) drawn &= absolute(rgb[channel]) < kHuge;
    const TileRects touched = touched_tiles(u, v, extent, camera);
    Lanes rows[8] = {u, v, -0.5f / variance, opacity, rgb[0], rgb[1], rgb[2], cam_z};  // as in Splat
    transpose(rows);
    const unsigned is_drawn = bits_of_mask(drawn);
    for (int i = 0; i < count; ++i) {  // what is not drawn is overwritten: a branch for each would cost more
      store(&splats[visible].u, rows[i]);
      rects[visible] = touched[i];
      ids[visible] = std::uint32_t(first + i);
      visible += is_drawn >> i & 1;
    }
  }
  return visible - begin;
}

// A tile's upper left pixel.
struct Corner {
  Uniform x, y;
};

static inline Corner corner(const TileList& tile) { return {uniform_of_int(tile.x), uniform_of_int(tile.y)}; }

// A splat within one tile: the two separable factors of its alpha (per column, per row).
struct Footprint {
  Lanes across;
  float down[8];
};

static inline Footprint footprint(const Splat& s, const Corner& tile) {
  Footprint f;
  const Lanes dx = iota() + (tile.x - uniform(s.u)), dy = iota() + (tile.y - uniform(s.v));
  f.across = exp(dx * dx * s.falloff);
  store(f.down, s.opacity * exp(dy * dy * s.falloff));
  return f;
}

// Returns a mask of the lanes of a tile's row that are inside the image.
static inline IntLanes on_image(const TileList& tile, const Camera& camera, int row) {
  return int_iota() < splat_int(tile.y + row < camera.height ? camera.width - tile.x : 0);
}

constexpr int kGroups = kTile / kRows;  // of rows that are blended at once

// Groups of rows, as a bit for each at its first row.
typedef std::uint32_t Groups;
constexpr Groups kAllGroups = kRows == 1 ? 0xff : 0x55;

static inline Groups groups_of(Groups rows) { return kRows == 1 ? rows : (rows | rows >> 1) & kAllGroups; }

// Returns the groups with a pixel that is not saturated. Group has a transmittance T. Call it at least every 16
// splats: it also resets the transmittance of saturated pixels, before that becomes a denormal number.
template <typename Group>
static inline Groups open_groups(Group* rows) {
  Groups open = 0;
  for (int i = 0; i < kGroups; ++i) {
    const IntRows more = rows[i].T >= kMinTransmittance;
    rows[i].T = either(more, rows[i].T, repeated(splat(0.5f * kMinTransmittance)));
    open |= Groups(any(more)) << kRows * i;
  }
  return open;
}

static inline int columns_of(const TileList& tile, const Camera& camera) {
  return camera.width - tile.x < kTile ? camera.width - tile.x : kTile;
}

static inline int rows_in(const TileList& tile, const Camera& camera) {
  return camera.height - tile.y < kTile ? camera.height - tile.y : kTile;
}

static inline Lanes load_row(const float* plane, const TileList& tile, const Camera& camera, int row) {
  if (tile.y + row >= camera.height) return Lanes{};
  const float* from = plane + std::size_t(tile.y + row) * camera.width + tile.x;
  return load_some(from, columns_of(tile, camera), Lanes{});
}

static inline void store_row(float* plane, const TileList& tile, const Camera& camera, int row, Lanes value) {
  if (tile.y + row >= camera.height) return;
  float values[8];
  store(values, value);
  __builtin_memcpy(plane + std::size_t(tile.y + row) * camera.width + tile.x, values,
                   sizeof(float) * columns_of(tile, camera));
}

static inline Rows load_rows(const float* plane, const TileList& tile, const Camera& camera, int row) {
  return rows_of([&](int i) { return load_row(plane, tile, camera, row + i); });
}

static inline void store_rows(float* plane, const TileList& tile, const Camera& camera, int row, Rows values) {
  for (int i = 0; i < kRows; ++i) store_row(plane, tile, camera, row + i, row_of(values, i));
}

static inline Rows first_transmittance(const TileList& tile, const Camera& camera, int row) {
  return rows_of([&](int i) { return keep(on_image(tile, camera, row + i), splat(1.0f)); });
}

struct Pixels {  // a group of rows being blended
  Rows T, r, g, b, depth, silhouette;
};

static inline void start(Pixels* pixels, const TileList& tile, const Camera& camera) {
  for (int i = 0; i < kGroups; ++i) {
    pixels[i] = Pixels{};
    pixels[i].T = first_transmittance(tile, camera, kRows * i);
  }
}

// A splat's values, as operands.
struct Values {
  Uniform r, g, b, z;
};

static inline Values values_of(const Splat& s) { return {uniform(s.r), uniform(s.g), uniform(s.b), uniform(s.z)}; }

// What a splat takes in a group of rows: its alpha, and its weight, which is alpha times transmittance. Both are zero
// in pixels that it does not reach, and in those that are saturated.
struct Taken {
  Rows alpha, w;
};

// Lowers the transmittance by a splat.
static inline Taken take(Rows& T, Rows raw_alpha) {
  const Rows alpha = keep(raw_alpha >= kMinAlpha, min(raw_alpha, kMaxAlpha));
  const Rows taken = keep(T >= kMinTransmittance, alpha), w = taken * T;
  T *= 1.0f - alpha;  // also in saturated pixels: the shortest path to the next splat's T
  return {taken, w};
}

// Returns what the splat takes.
template <bool kSilhouette>
static inline Taken blend(Pixels& pixels, Rows raw_alpha, const Values& s) {
  const Taken taken = take(pixels.T, raw_alpha);
  const Rows w = taken.w;
  pixels.r += w * s.r;
  pixels.g += w * s.g;
  pixels.b += w * s.b;
  pixels.depth += w * s.z;
  if (kSilhouette) pixels.silhouette += w;
  return taken;
}

// Returns rows whose values are the same in all columns.
static inline Rows spread(const float* per_row) {
  return rows_of([&](int i) { return splat(per_row[i]); });
}

// Returns a splat's alpha in a group of rows, before it is clamped.
static inline Rows raw_alpha(const Footprint& f, int group) {
  return spread(f.down + kRows * group) * repeated(f.across);
}

constexpr std::size_t kBatch = 16;

// Returns the lanes of the rows of a tile in which a splat reaches a pixel.
static inline IntLanes reached_rows(const Footprint& f) { return load(f.down) * highest(f.across) >= kMinAlpha; }

// Up to kBatch splats in a tile, and the groups of rows that each reaches.
struct Batch {
  std::size_t size;
  const Footprint* footprints;
  Values values[kBatch];
  std::int32_t reached[8];  // the splats that reach a row, as a bit per splat
};

// Finds where the splats of a batch are seen: the groups that they reach and that are open. Writes them to `groups`
// unless it is null.
static inline void find_reached(Batch& batch, Groups open, std::uint8_t* groups) {
  IntLanes by_row{};
  for (std::size_t k = 0; k < batch.size; ++k) {
    const IntLanes rows = reached_rows(batch.footprints[k]);
    by_row |= rows & (1 << k);
    if (groups) groups[k] = std::uint8_t(groups_of(bits_of_mask(rows)) & open);
  }
  store(batch.reached, by_row);
}

// Calls visit(group, its number, splat of the batch) where the splats of a batch are seen, group of rows by group, so
// that its pixels stay in registers. What a splat does not reach is skipped: it would add zeros.
template <typename Group, typename Visit>
static inline void for_reached(Group* groups, const Batch& batch, Groups open, const Visit& visit) {
  for (; open != 0; open &= open - 1) {
    const int row = __builtin_ctz(open), i = row / kRows;
    Group rows = groups[i];
    for (auto left = Groups(batch.reached[row] | batch.reached[row + kRows - 1]); left != 0; left &= left - 1)
      visit(rows, i, __builtin_ctz(left));
    groups[i] = rows;
  }
}

// Calls visit(batch, the groups that are open, number of its first splat) for a tile's splats, front to back, until the
// tile is saturated. Returns how many splats that were. Group is as in open_groups().
template <typename Group, typename Visit>
__attribute__((always_inline)) static inline std::size_t for_batches(Group* rows, const TileList& tile,
                                                                     const Splat* splats, const Visit& visit) {
  const Corner at = corner(tile);
  Footprint footprints[kBatch];
  Batch batch;
  batch.footprints = footprints;
  std::size_t first = 0;
  for (; first < tile.count; first += batch.size) {
    const Groups open = open_groups(rows);
    if (open == 0) break;
    batch.size = tile.count - first < kBatch ? tile.count - first : kBatch;
    for (std::size_t k = 0; k < batch.size; ++k) {
      const Splat& s = splats[tile.splats[first + k]];
      batch.values[k] = values_of(s);
      footprints[k] = footprint(s, at);
    }
    visit(batch, open, first);
  }
  return first;
}

static void forward(const TileList& tile, const Splat* splats, const Camera& camera, const Images& images) {
  const std::size_t plane = std::size_t(camera.width) * camera.height;
  Pixels pixels[kGroups];
  start(pixels, tile, camera);
  for_batches(pixels, tile, splats, [&](Batch& batch, Groups open, std::size_t) {
    find_reached(batch, open, nullptr);
    for_reached(pixels, batch, open, [&](Pixels& rows, int i, int k) {
      blend<true>(rows, raw_alpha(batch.footprints[k], i), batch.values[k]);
    });
  });
  for (int i = 0; i < kGroups; ++i) {
    store_rows(images.rgb, tile, camera, kRows * i, pixels[i].r);
    store_rows(images.rgb + plane, tile, camera, kRows * i, pixels[i].g);
    store_rows(images.rgb + 2 * plane, tile, camera, kRows * i, pixels[i].b);
    store_rows(images.depth, tile, camera, kRows * i, pixels[i].depth);
    store_rows(images.silhouette, tile, camera, kRows * i, pixels[i].silhouette);
  }
}

// A group of rows in the backward pass, which goes back to front.
struct PixelGradients {
  Rows r, g, b, depth, silhouette;  // gradients of the loss by the pixel's values
  Rows behind;                      // see blend_back()
};

// The sums of blend_back() over the groups of rows.
struct Sums {
  FoldedRows by_alpha, by_y, by_y_squared, by_r, by_g, by_b, by_z;
};

// The backward pass of one splat in a group of rows, dy pixels below it. With q = sum over channels of (gradient of the
// channel times value of the splat), dL/dalpha = T (q - behind), where `behind` is the blend of the q behind the splat.
template <bool kMap, bool kSilhouette>
static inline void blend_back(PixelGradients& at, const Values& s, const Taken& taken, Rows dy, Sums& sums) {
  Rows q = at.r * s.r + at.g * s.g + at.b * s.b + at.depth * s.z;
  if (kSilhouette) q += at.silhouette;
  const Rows more = q - at.behind;
  at.behind += taken.alpha * more;
  const Rows by_log_alpha = keep(taken.alpha < kMaxAlpha, taken.w * more), by_y = by_log_alpha * dy;
  add(sums.by_alpha, by_log_alpha);
  add(sums.by_y, by_y);
  add_product(sums.by_y_squared, by_y, dy);
  if (kMap) {
    add_product(sums.by_r, taken.w, at.r);
    add_product(sums.by_g, taken.w, at.g);
    add_product(sums.by_b, taken.w, at.b);
  }
  add_product(sums.by_z, taken.w, at.depth);
}

// Which rows a tile's groups hold.
struct RowNumbers {
  Rows of[kGroups];
  RowNumbers() {
    for (int i = 0; i < kGroups; ++i) of[i] = rows_of([&](int row) { return splat(float(kRows * i + row)); });
  }
};

// The backward pass of one splat in some groups of a tile's rows.
template <bool kMap, bool kSilhouette>
static inline void blend_back(PixelGradients* rows, const Splat& s, const Corner& tile, const Taken* taken,
                              const RowNumbers& numbers, Groups groups, SplatGradient& gradient) {
  if (groups == 0) return;
  const Values values = values_of(s);
  const Uniform above = tile.y - uniform(s.v);
  Sums by{};
  for (; groups != 0; groups &= groups - 1) {
    const int i = __builtin_ctz(groups) / kRows;
    blend_back<kMap, kSilhouette>(rows[i], values, taken[i], numbers.of[i] + above, by);
  }
  const Lanes dx = iota() + (tile.x - uniform(s.u));
  const Lanes by_column = folded(by.by_alpha), by_x = by_column * dx;
  const Lanes sums[8] = {by_column,       by_x,
                         folded(by.by_y), by_x * dx + folded(by.by_y_squared),
                         folded(by.by_r), folded(by.by_g),
                         folded(by.by_b), folded(by.by_z)};  // as in SplatGradient
  float* into = &gradient.log_alpha;
  store(into, load(into) + row_sums(sums));
}

// The members of a row do not fit into the first cache, and are used in the order of their depth.
constexpr std::size_t kAhead = 8;

static inline void fetch(const Splat* splats, SplatGradient* gradients, std::uint32_t member) {
  __builtin_prefetch(splats + member);
  __builtin_prefetch(gradients + member, 1);
}

// The list of a tile, in parts of up to kPart splats: what a part takes is kept, and what the parts before it took is
// found again from their start. Few tiles have more than one part.
static inline TileList part_of(const TileList& tile, std::size_t first) {
  const std::size_t left = tile.count - first;
  return {tile.x, tile.y, tile.splats + first, left < kPart ? left : kPart};
}

// What the splats of a part take, front to back.
struct TakenByPart {
  Taken* of_splats;      // kGroups for each
  std::uint8_t* groups;  // those in which it is seen
  std::size_t count;     // of the splats in front of what saturates the tile
};

struct Transmittance {
  Rows T;
};

// What the splats of a tile take.
struct TakenByAll {
  Transmittance (*starts)[kGroups];  // of each part
  std::size_t first;                 // splat of the last part
  TakenByPart last;
};
static_assert(sizeof(Transmittance[kGroups]) <= kScratchPerPart * sizeof(float) &&
                  kGroups * sizeof(Taken) + 1 <= kScratchPerSplat * sizeof(float) && kPart % kBatch == 0,
              "scratch is allocated elsewhere");

// Blends a part. Calls blend(group, raw alpha, values of the splat), which returns what the splat takes.
template <typename Group, typename Blend>
__attribute__((always_inline)) static inline TakenByPart take_part(Group* rows, const TileList& part,
                                                                   const Splat* splats, Taken* scratch,
                                                                   const Blend& blend) {
  TakenByPart to{scratch, reinterpret_cast<std::uint8_t*>(scratch + kGroups * part.count), 0};
  to.count = for_batches(rows, part, splats, [&](Batch& batch, Groups open, std::size_t first) {
    find_reached(batch, open, to.groups + first);
    Taken* taken = to.of_splats + kGroups * first;
    for_reached(rows, batch, open, [&](Group& group, int i, int k) {
      taken[kGroups * k + i] = blend(group, raw_alpha(batch.footprints[k], i), batch.values[k]);
    });
  });
  return to;
}

// Blends a tile of more than one part. Not inlined, because such tiles are rare.
template <typename Group, typename Blend>
__attribute__((noinline)) static TakenByAll take_parts(Group* rows, const TileList& tile, const Splat* splats,
                                                       float* scratch, const Blend& blend) {
  TakenByAll all{reinterpret_cast<Transmittance(*)[kGroups]>(scratch), 0, {}};
  Taken* taken = reinterpret_cast<Taken*>(scratch + kScratchPerPart * parts_of(tile.count));
  for (std::size_t first = 0; first < tile.count; first += kPart) {
    for (int i = 0; i < kGroups; ++i) all.starts[first / kPart][i].T = rows[i].T;
    const TileList part = part_of(tile, first);
    all.first = first;
    all.last = take_part(rows, part, splats, taken, blend);
    if (all.last.count < part.count) break;
  }
  return all;
}

// Blends a tile, as take_part() a part.
template <typename Group, typename Blend>
static inline TakenByAll take_all(Group* rows, const TileList& tile, const Splat* splats, float* scratch,
                                  const Blend& blend) {
  if (tile.count > kPart) return take_parts(rows, tile, splats, scratch, blend);
  return {nullptr, 0, take_part(rows, tile, splats, reinterpret_cast<Taken*>(scratch), blend)};
}

// The backward pass of a part of a tile: adds to the gradients.
template <bool kMap, bool kSilhouette>
__attribute__((always_inline)) static inline void blend_back(PixelGradients* rows, const TileList& part,
                                                             const Splat* splats, const TakenByPart& taken,
                                                             SplatGradient* gradients) {
  const Corner at = corner(part);
  const RowNumbers numbers;
  for (std::size_t k = taken.count; k-- > 0;) {
    if (k >= kAhead) fetch(splats, gradients, part.splats[k - kAhead]);
    const std::uint32_t member = part.splats[k];
    blend_back<kMap, kSilhouette>(rows, splats[member], at, taken.of_splats + kGroups * k, numbers, taken.groups[k],
                                  gradients[member]);
  }
}

// The backward pass of a tile of more than one part. Not inlined, as take_parts().
template <bool kMap, bool kSilhouette>
__attribute__((noinline)) static void blend_back_parts(PixelGradients* rows, const TileList& tile, const Splat* splats,
                                                       const TakenByAll& all, SplatGradient* gradients) {
  TakenByPart taken = all.last;
  for (std::size_t first = all.first;; first -= kPart) {
    const TileList part = part_of(tile, first);
    if (first < all.first)
      taken = take_part(all.starts[first / kPart], part, splats, taken.of_splats,
                        [](Transmittance& rows, Rows raw_alpha, const Values&) { return take(rows.T, raw_alpha); });
    blend_back<kMap, kSilhouette>(rows, part, splats, taken, gradients);
    if (first == 0) return;
  }
}

// The backward pass of a tile.
template <bool kMap, bool kSilhouette>
static inline void blend_back(PixelGradients* rows, const TileList& tile, const Splat* splats, const TakenByAll& all,
                              SplatGradient* gradients) {
  if (tile.count > kPart) return blend_back_parts<kMap, kSilhouette>(rows, tile, splats, all, gradients);
  blend_back<kMap, kSilhouette>(rows, tile, splats, all.last, gradients);
}

template <bool kMap>
static inline void backward_tile(const TileList& tile, const Splat* splats, const Camera& camera,
                                 const ConstImages& gradient, float* scratch, SplatGradient* gradients) {
  Transmittance transmittances[kGroups];
  for (int i = 0; i < kGroups; ++i) transmittances[i].T = first_transmittance(tile, camera, kRows * i);
  const TakenByAll all =
      take_all(transmittances, tile, splats, scratch,
               [](Transmittance& rows, Rows raw_alpha, const Values&) { return take(rows.T, raw_alpha); });
  const std::size_t plane = std::size_t(camera.width) * camera.height;
  PixelGradients rows[kGroups];
  for (int i = 0; i < kGroups; ++i) {
    const auto load = [&](const float* image) { return load_rows(image, tile, camera, kRows * i); };
    rows[i] = {load(gradient.rgb),   load(gradient.rgb + plane), load(gradient.rgb + 2 * plane),
               load(gradient.depth), load(gradient.silhouette),  Rows{}};
  }
  blend_back<kMap, true>(rows, tile, splats, all, gradients);
}

static void backward(const TileList& tile, const Splat* splats, const Camera& camera, const ConstImages& gradient,
                     bool map, float* scratch, SplatGradient* gradients) {
  if (map)
    backward_tile<true>(tile, splats, camera, gradient, scratch, gradients);
  else
    backward_tile<false>(tile, splats, camera, gradient, scratch, gradients);
}

static inline Lanes load_bytes(const std::uint8_t* pixels, int columns, int channel) {
  std::int32_t values[8] = {};
  for (int i = 0; i < columns; ++i) values[i] = pixels[3 * i + channel];
  return to_float(load(values)) * (1.0f / 255.0f);
}

// Huber's loss of one row, and its gradient by the pixel values.
struct Comparison {
  Lanes r, g, b, depth;
  double loss;
};

// Huber's loss of a channel.
struct Huber {
  float weight, inverse_limit, half_limit;
};

static inline Huber huber(float weight, float limit) { return {weight, 1.0f / limit, 0.5f * limit}; }

// Gradient of Huber's loss: linear up to the limit, constant beyond.
static inline Lanes huber_gradient(Lanes residual, const Huber& huber) {
  const Lanes gradient = residual * huber.inverse_limit;
  return max(min(gradient, splat(1.0f)), splat(-1.0f));
}

static inline Lanes huber_loss(Lanes residual, Lanes gradient, const Huber& huber) {
  return gradient * (residual - huber.half_limit * gradient);
}

// A target, and the loss of its colour and depth.
struct Compared {
  const Target& target;
  Huber color, depth;
};

static inline Comparison compare(Lanes r, Lanes g, Lanes b, Lanes depth, const TileList& tile, const Camera& camera,
                                 int row, const Compared& to) {
  const Target& target = to.target;
  Comparison result{};
  if (tile.y + row >= camera.height) return result;
  const int columns = columns_of(tile, camera);
  const std::size_t at = std::size_t(tile.y + row) * camera.width + tile.x;
  const Lanes reading = load_some(target.depth + at, columns, Lanes{});
  const IntLanes real = (int_iota() < splat_int(columns)) & (reading >= 0.0f);
  const std::uint8_t* colors = target.rgb + 3 * at;
  const Lanes red = keep(real, r - load_bytes(colors, columns, 0)), by_r = huber_gradient(red, to.color);
  const Lanes green = keep(real, g - load_bytes(colors, columns, 1)), by_g = huber_gradient(green, to.color);
  const Lanes blue = keep(real, b - load_bytes(colors, columns, 2)), by_b = huber_gradient(blue, to.color);
  const Lanes range = keep(real & (reading > 0.0f), depth - reading), by_range = huber_gradient(range, to.depth);
  const Lanes loss = to.color.weight * (huber_loss(red, by_r, to.color) + huber_loss(green, by_g, to.color) +
                                        huber_loss(blue, by_b, to.color)) +
                     to.depth.weight * huber_loss(range, by_range, to.depth);
  result.loss = sum(loss);
  result.r = to.color.weight * by_r, result.g = to.color.weight * by_g, result.b = to.color.weight * by_b;
  result.depth = to.depth.weight * by_range;
  return result;
}

// Starts the backward pass of a group of rows: compares them with the target. Returns their loss.
static inline double start(PixelGradients& rows, const Pixels& drawn, const TileList& tile, const Camera& camera,
                           int row, const Compared& to) {
  Comparison compared[kRows];
  double loss = 0.0;
  for (int i = 0; i < kRows; ++i) {
    compared[i] = compare(row_of(drawn.r, i), row_of(drawn.g, i), row_of(drawn.b, i), row_of(drawn.depth, i), tile,
                          camera, row + i, to);
    loss += compared[i].loss;
  }
  rows = {rows_of([&](int i) { return compared[i].r; }),
          rows_of([&](int i) { return compared[i].g; }),
          rows_of([&](int i) { return compared[i].b; }),
          rows_of([&](int i) { return compared[i].depth; }),
          Rows{},
          Rows{}};
  return loss;
}

static double fit(const TileList& tile, const Splat* splats, const Camera& camera, const Target& target, float* scratch,
                  SplatGradient* gradients) {
  Pixels pixels[kGroups];
  start(pixels, tile, camera);
  const TakenByAll all = take_all(pixels, tile, splats, scratch, [](Pixels& rows, Rows raw_alpha, const Values& s) {
    return blend<false>(rows, raw_alpha, s);
  });
  const Compared to{target, huber(target.color_weight, target.color_limit),
                    huber(target.depth_weight, target.depth_limit)};
  double loss = 0.0;
  PixelGradients rows[kGroups];
  for (int i = 0; i < kGroups; ++i) loss += start(rows[i], pixels[i], tile, camera, kRows * i, to);
  if (loss < double(target.enough) * (columns_of(tile, camera) * rows_in(tile, camera))) return loss;
  blend_back<true, false>(rows, tile, splats, all, gradients);
  return loss;
}

constexpr float kBeta1 = 0.9f, kBeta2 = 0.9f, kEpsilon = 1e-15f;

// The inverse of Adam's bias corrections, by the number of steps; of the first moment as it is one step ahead.
struct BiasCorrections {
  float first[256], second[256];
  constexpr BiasCorrections() : first(), second() {
    float left1 = kBeta1, left2 = 1.0f;
    for (int i = 0; i < 256; ++i) {
      first[i] = 1.0f / (1.0f - left1), second[i] = i == 0 ? 0.0f : 1.0f / (1.0f - left2);  // there is no step 0
      left1 *= kBeta1, left2 *= kBeta2;
    }
  }
};
static constexpr BiasCorrections kBiasCorrections;

// Writes the gradients by the Gaussians of eight splats: mean in the camera's axes, log scale, logit opacity and rgb,
// in the order of the moments, a lane per splat. Returns which splats have any, as a bit per splat.
static inline unsigned by_gaussians(const Splat* splats, const SplatGradient* gradients, const Camera& camera,
                                    Lanes* by_gaussian) {
  Lanes s[8], g[8];
  for (int i = 0; i < 8; ++i) s[i] = load(&splats[i].u), g[i] = load(&gradients[i].log_alpha);
  transpose(s), transpose(g);
  const BasicSplat<Lanes> splat{s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7]};
  const BasicSplatGradient<Lanes> gradient{g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]};
  const GaussianGradient<Lanes> by = through_projection(splat, gradient, camera);
  for (int axis = 0; axis < 3; ++axis) by_gaussian[axis] = by.camera[axis];
  by_gaussian[3] = by.log_scale, by_gaussian[4] = by.logit_opacity;
  by_gaussian[5] = gradient.r, by_gaussian[6] = gradient.g, by_gaussian[7] = gradient.b;
  return bits_of_mask((gradient.log_alpha != 0.0f) | (gradient.r != 0.0f) | (gradient.g != 0.0f) |
                      (gradient.b != 0.0f) | (gradient.z != 0.0f));
}

// Turns the gradients by eight means from the camera's axes to the world's, in place.
static inline void turn_to_world(const Pose& pose, Lanes* by_mean) {
  const Lanes x = by_mean[0], y = by_mean[1], z = by_mean[2];
  for (int axis = 0; axis < 3; ++axis) by_mean[axis] = pose.R[axis] * x + pose.R[3 + axis] * y + pose.R[6 + axis] * z;
}

// Takes a step of one Gaussian: Adam with Nesterov's momentum. Widens the bounds, which are in the order of the
// gradient.
static inline void adam_step(std::size_t id, Lanes gradient, Lanes rate, const MutableGaussians& gaussians,
                             const AdamState& adam, Lanes* lowest, Lanes* highest) {
  float* moments = adam.moments + 16 * id;
  const Lanes first = kBeta1 * load(moments) + (1.0f - kBeta1) * gradient;
  const Lanes second = kBeta2 * load(moments + 8) + (1.0f - kBeta2) * gradient * gradient;
  const int step = adam.steps[id] < 255 ? adam.steps[id] + 1 : 255;
  const Lanes ahead = (kBeta1 * first + (1.0f - kBeta1) * gradient) * kBiasCorrections.first[step];
  const Lanes move = rate * ahead / (sqrt(second * kBiasCorrections.second[step]) + kEpsilon);
  const IntLanes usable = (absolute(first) < kHuge) & (second < kHuge) & (absolute(move) < kHuge);
  if (bits_of_mask(usable) != 0xff) return;  // an overflow would stay in the moments for ever
  store(moments, first);
  store(moments + 8, second);
  adam.steps[id] = std::uint8_t(step);
  float *mean = gaussians.means + 3 * id, *rgb = gaussians.rgb + 3 * id;
  float values[8] = {mean[0], mean[1], mean[2], gaussians.log_scales[id], gaussians.logit_opacities[id],
                     rgb[0],  rgb[1],  rgb[2]};
  const Lanes moved = load(values) - move;
  *lowest = min(moved, *lowest), *highest = max(moved, *highest);
  store(values, moved);
  for (int i = 0; i < 3; ++i) mean[i] = values[i], rgb[i] = values[5 + i];
  gaussians.log_scales[id] = values[3], gaussians.logit_opacities[id] = values[4];
}

// Calls visit(at, how many, splats, gradients) for splats eight at a time, the last ones padded by zeros.
template <typename Visit>
static inline void for_eights(const Splat* splats, const SplatGradient* gradients, std::size_t count,
                              const Visit& visit) {
  std::size_t at = 0;
  for (; at + 8 <= count; at += 8) visit(at, 8, splats + at, gradients + at);
  if (at == count) return;
  Splat last_splats[8] = {};
  SplatGradient last_gradients[8] = {};
  for (std::size_t i = at; i < count; ++i) last_splats[i - at] = splats[i], last_gradients[i - at] = gradients[i];
  visit(at, int(count - at), last_splats, last_gradients);
}

static void project_back(const Splat* splats, const std::uint32_t* ids, const SplatGradient* gradients,
                         std::size_t count, const Camera& camera, const Pose& pose, const float* means,
                         const MapGradients& map, double* pose_gradient) {
  Lanes by_pose[4] = {};  // its columns, one lane per row
  for_eights(splats, gradients, count, [&](std::size_t at, int some, const Splat* s, const SplatGradient* g) {
    Lanes in_camera[8], in_world[8];
    by_gaussians(s, g, camera, in_camera);
    for (int i = 0; i < 8; ++i) in_world[i] = in_camera[i];
    turn_to_world(pose, in_world);
    transpose(in_camera), transpose(in_world);
    for (int i = 0; i < some; ++i) {
      const std::size_t id = ids[at + i];
      for (int axis = 0; axis < 3; ++axis) by_pose[axis] += in_camera[i] * splat(means[3 * id + axis]);
      by_pose[3] += in_camera[i];
      float values[8];
      store(values, in_world[i]);
      if (map.means) __builtin_memcpy(map.means + 3 * id, values, 3 * sizeof(float));
      if (map.log_scales) map.log_scales[id] = values[3];
      if (map.logit_opacities) map.logit_opacities[id] = values[4];
      if (map.rgb) __builtin_memcpy(map.rgb + 3 * id, values + 5, 3 * sizeof(float));
    }
  });
  for (int column = 0; column < 4; ++column) {
    float rows[8];
    store(rows, by_pose[column]);
    for (int row = 0; row < 3; ++row) pose_gradient[4 * row + column] += rows[row];
  }
}

static void update(const Splat* splats, const std::uint32_t* ids, const SplatGradient* gradients, std::size_t count,
                   const Camera& camera, const Pose& pose, const MutableGaussians& gaussians, const AdamState& adam,
                   const AdamRates& rates, float* bounds) {
  const float by_value[8] = {rates.means,           rates.means, rates.means, rates.log_scales,
                             rates.logit_opacities, rates.rgb,   rates.rgb,   rates.rgb};
  const Lanes rate = load(by_value);
  float low[8] = {}, high[8] = {};
  for (int i = 0; bounds && i < 3; ++i) low[i] = bounds[i], high[i] = bounds[3 + i];
  if (bounds) high[3] = bounds[6];
  Lanes lowest = load(low), highest = load(high);
  for_eights(splats, gradients, count, [&](std::size_t at, int some, const Splat* s, const SplatGradient* g) {
    Lanes by_gaussian[8];
    const unsigned has_any = by_gaussians(s, g, camera, by_gaussian);
    turn_to_world(pose, by_gaussian);
    transpose(by_gaussian);
    for (int i = 0; i < some; ++i)
      if (has_any >> i & 1) adam_step(ids[at + i], by_gaussian[i], rate, gaussians, adam, &lowest, &highest);
  });
  store(low, lowest), store(high, highest);
  for (int i = 0; bounds && i < 3; ++i) bounds[i] = low[i], bounds[3 + i] = high[i];
  if (bounds) bounds[6] = high[3];
}

static constexpr Kernels table(const char* name) {
  return {project, forward, backward, fit, project_back, update, align, name};
}
