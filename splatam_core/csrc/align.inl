// Direct alignment: each point of a reference image is moved and projected into a frame. Its brightness and depth are
// compared with those of the frame there. Included after lanes.inl.

static inline void tally(std::uint32_t* bins, Lanes residuals, IntLanes seen) {
  std::int32_t index[8];
  store(index, (bits(absolute(residuals)) >> 20) - ((127 - 64) << 3));
  const unsigned is_seen = bits_of_mask(seen);
  for (int i = 0; i < 8; ++i)
    if (is_seen >> i & 1) ++bins[index[i] < 0 ? 0 : index[i] >= kResidualBins ? kResidualBins - 1 : index[i]];
}

// Student's t with five degrees of freedom, as in Kerl et al. 2013.
static inline Lanes robust_weight(Lanes squared) { return 6.0f / (5.0f + squared); }

// Samples the layers of the frame bilinearly at eight positions: sampled[k] holds layer k, one lane per position.
static inline void sample(const float* layers, int width, Lanes u, Lanes v, IntLanes inside, Lanes* sampled) {
  const IntLanes column = truncated(keep(inside, u)), row = truncated(keep(inside, v));
  const Lanes to_right = u - to_float(column), to_below = v - to_float(row);
  std::int32_t columns[8], rows[8];
  float right[8], left[8], below[8], above[8];
  store(columns, column), store(rows, row);
  store(right, to_right), store(left, 1.0f - to_right), store(below, to_below), store(above, 1.0f - to_below);
  const unsigned is_inside = bits_of_mask(inside);
  for (int i = 0; i < 8; ++i) {
    if (!(is_inside >> i & 1)) {
      sampled[i] = Lanes{};
      continue;
    }
    const float* at = layers + (std::size_t(rows[i]) * width + columns[i]) * kLayers;
    const float* under = at + std::size_t(width) * kLayers;
    const Lanes upper = load(at) * left[i] + load(at + kLayers) * right[i];
    const Lanes lower = load(under) * left[i] + load(under + kLayers) * right[i];
    sampled[i] = upper * above[i] + lower * below[i];
  }
  transpose(sampled);
}

// Writes the derivatives [6] of an image value at the projected points by a twist that moves the points. (a, b) is the
// image gradient times focal length over z.
static inline void gradients_by_twist(Lanes a, Lanes b, Lanes x, Lanes y, Lanes z, Lanes inverse_z,
                                      Lanes* derivatives) {
  const Lanes c = -(a * x + b * y) * inverse_z;
  derivatives[0] = a, derivatives[1] = b, derivatives[2] = c;
  derivatives[3] = c * y - b * z, derivatives[4] = a * z - c * x, derivatives[5] = b * x - a * y;
}

// Eight points of the reference, moved into the frame's camera and projected.
struct Moved {
  Lanes x, y, z, inverse_z, u, v;
  IntLanes inside;
};

static inline Moved moved(const Pose& motion, Lanes px, Lanes py, Lanes pz, IntLanes known, const Camera& camera) {
  const float *R = motion.R, *t = motion.t;
  Moved p;
  p.x = R[0] * px + R[1] * py + R[2] * pz + t[0];
  p.y = R[3] * px + R[4] * py + R[5] * pz + t[1];
  p.z = R[6] * px + R[7] * py + R[8] * pz + t[2];
  p.inverse_z = 1.0f / p.z;
  p.u = camera.fx * p.x * p.inverse_z + camera.cx, p.v = camera.fy * p.y * p.inverse_z + camera.cy;
  p.inside = known & (p.z > 0.0f) & (p.u >= 0.0f) & (p.v >= 0.0f) & (p.u < float(camera.width - 1)) &
             (p.v < float(camera.height - 1));
  return p;
}

constexpr int kProducts = kUnknowns * (kUnknowns + 1) / 2;

// The sums over a row, one lane per pixel modulo eight.
struct RowSums {
  Lanes values[kProducts + kUnknowns + 2];    // H, g, cost and nothing: whole groups of eight
  IntLanes points, compared, seen, agreeing;  // negative
  Lanes* H() { return values; }
  Lanes* g() { return values + kProducts; }
  Lanes& cost() { return values[kProducts + kUnknowns]; }
};
static_assert(sizeof(RowSums::values) % (8 * sizeof(Lanes)) == 0, "eight are summed at once");

// Not inlined: it runs once per row, and would take registers from the pixels' loop.
__attribute__((noinline)) static void add(AlignmentSums& sums, const RowSums& row) {
  constexpr int kCount = sizeof row.values / sizeof(Lanes);
  float totals[kCount];
  for (int i = 0; i < kCount; i += 8) store(totals + i, row_sums(row.values + i));
  for (int i = 0; i < kProducts; ++i) sums.H[i] += totals[i];
  for (int i = 0; i < kUnknowns; ++i) sums.g[i] += totals[kProducts + i];
  sums.cost += totals[kProducts + kUnknowns];
  sums.points -= sum(row.points), sums.compared -= sum(row.compared);
  sums.seen -= sum(row.seen), sums.agreeing -= sum(row.agreeing);
}

static void align(const float* brightness, const float* depth, const Camera& camera, int begin, int end,
                  const float* layers, const Pose& color_motion, const Pose& depth_motion,
                  const AlignmentSettings& settings, AlignmentSums& sums, ResidualHistogram& histogram) {
  const Lanes nan = splat(__builtin_nanf(""));
  const bool is_split = __builtin_memcmp(&color_motion, &depth_motion, sizeof(Pose)) != 0;
  const Lanes photometric_scale = splat(settings.photometric_scale), depth_scale = splat(settings.depth_scale);
  const Lanes photometric_precision = 1.0f / (photometric_scale * photometric_scale);
  const Lanes depth_precision = 1.0f / (depth_scale * depth_scale);
  for (int row = begin; row < end; ++row) {
    RowSums total{};
    const Lanes ray_y = (to_float(splat_int(row)) - camera.cy) / camera.fy;
    for (int first = 0; first < camera.width; first += 8) {
      const int columns = camera.width - first < 8 ? camera.width - first : 8;
      const std::size_t at = std::size_t(row) * camera.width + first;
      const Lanes intensity = load_some(brightness + at, columns, nan), range = load_some(depth + at, columns, nan);
      const IntLanes known = range > 0.0f;  // false for NaN
      if (!any(known)) continue;
      total.points += known;
      const Lanes px = (iota() + (to_float(splat_int(first)) - camera.cx)) / camera.fx * range, py = ray_y * range;
      const Moved depth_point = moved(depth_motion, px, py, range, known, camera);
      Lanes frame[kLayers];
      sample(layers, camera.width, depth_point.u, depth_point.v, depth_point.inside, frame);
      Lanes depth_residual = (frame[3] - depth_point.z) * depth_point.inverse_z;
      total.compared += depth_point.inside & (frame[3] == frame[3]);
      IntLanes seen = depth_point.inside & (absolute(depth_residual) < settings.max_depth_ratio);  // false for NaN
      // Colour needs the depth of the reference only: a point where the frame has no reading is compared by colour
      // alone.
      IntLanes lit = seen | (depth_point.inside & (frame[3] != frame[3]));
      Lanes by_photometric[kUnknowns], by_depth[6];
      const Lanes tilt_x = frame[4] * camera.fx * depth_point.inverse_z,
                  tilt_y = frame[5] * camera.fy * depth_point.inverse_z;
      // Cosine between ray and surface normal: turns the depth difference along the ray into a distance from the
      // surface.
      const Lanes incidence_cosine = 1.0f / sqrt(1.0f + tilt_x * tilt_x + tilt_y * tilt_y);
      gradients_by_twist(tilt_x, tilt_y, depth_point.x, depth_point.y, depth_point.z, depth_point.inverse_z, by_depth);
      by_depth[2] -= 1.0f;
      by_depth[3] -= depth_point.y;
      by_depth[4] += depth_point.x;
      const Moved color_point = is_split ? moved(color_motion, px, py, range, known, camera) : depth_point;
      if (is_split) {
        seen &= color_point.inside, lit &= color_point.inside;
        sample(layers, camera.width, color_point.u, color_point.v, lit, frame);
      }
      total.seen += seen;
      Lanes photometric_residual = keep(lit, frame[0] - (settings.gain * intensity + settings.bias));
      depth_residual = keep(seen, depth_residual * incidence_cosine);
      tally(histogram.photometric, photometric_residual, lit);
      tally(histogram.depth, depth_residual, seen);
      total.agreeing += seen & (absolute(photometric_residual) <= settings.inlier_color) &
                        (absolute(depth_residual) <= settings.inlier_depth);

      gradients_by_twist(frame[1] * camera.fx * color_point.inverse_z, frame[2] * camera.fy * color_point.inverse_z,
                         color_point.x, color_point.y, color_point.z, color_point.inverse_z, by_photometric);
      by_photometric[6] = -intensity;
      by_photometric[7] = splat(-1.0f);
      by_photometric[8] = Lanes{};
      for (int i = 0; i < 6; ++i) by_photometric[8] += by_photometric[i] * settings.velocity[i];
      for (int i = 0; i < kUnknowns; ++i) by_photometric[i] = keep(lit, by_photometric[i]);
      for (int i = 0; i < 6; ++i) by_depth[i] = keep(seen, by_depth[i] * depth_point.inverse_z * incidence_cosine);

      const Lanes photometric_squared = photometric_residual * photometric_residual * photometric_precision;
      const Lanes depth_squared = depth_residual * depth_residual * depth_precision;
      const Lanes photometric_weight = robust_weight(photometric_squared) * photometric_precision;
      const Lanes depth_weight = robust_weight(depth_squared) * depth_precision;
      total.cost() +=
          keep(seen, photometric_squared / (5.0f + photometric_squared) + depth_squared / (5.0f + depth_squared));
      int entry = 0;
      for (int i = 0; i < kUnknowns; ++i) {
        const Lanes weighted_photometric = by_photometric[i] * photometric_weight;
        if (i < 6) {
          const Lanes weighted_depth = by_depth[i] * depth_weight;
          total.g()[i] += weighted_photometric * photometric_residual + weighted_depth * depth_residual;
          for (int k = i; k < 6; ++k)
            total.H()[entry++] += weighted_photometric * by_photometric[k] + weighted_depth * by_depth[k];
          for (int k = 6; k < kUnknowns; ++k) total.H()[entry++] += weighted_photometric * by_photometric[k];
        } else {
          total.g()[i] += weighted_photometric * photometric_residual;
          for (int k = i; k < kUnknowns; ++k) total.H()[entry++] += weighted_photometric * by_photometric[k];
        }
      }
    }
    add(sums, total);
  }
}
