// Direct alignment: each point of a reference picture, moved and projected into a frame, should find its own brightness
// and depth there. Included after lanes.inl.

// rows[i] lane k becomes rows[k] lane i.
static inline void transpose(Lanes* rows) {
  Lanes a[8], b[8];
  for (int i = 0; i < 8; i += 2) {
    a[i] = __builtin_shufflevector(rows[i], rows[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    a[i + 1] = __builtin_shufflevector(rows[i], rows[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 8; i += 4)
    for (int k = 0; k < 2; ++k) {
      b[i + k] = __builtin_shufflevector(a[i + k], a[i + k + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      b[i + k + 2] = __builtin_shufflevector(a[i + k], a[i + k + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  for (int k = 0; k < 4; ++k) {
    rows[k] = __builtin_shufflevector(b[k], b[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    rows[k + 4] = __builtin_shufflevector(b[k], b[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}

static inline Lanes absolute(Lanes x) { return x < 0.0f ? -x : x; }

static inline double sum(Lanes x) {
  double total = 0.0;
  for (int i = 0; i < 8; ++i) total += x[i];
  return total;
}

static inline int count(IntLanes mask) {
  int total = 0;
  for (int i = 0; i < 8; ++i) total -= mask[i];
  return total;
}

static inline void tally(std::uint32_t* bins, Lanes residuals, IntLanes seen) {
  const IntLanes index = (((IntLanes)absolute(residuals)) >> 20) - ((127 - 64) << 3);
  for (int i = 0; i < 8; ++i)
    if (seen[i]) ++bins[index[i] < 0 ? 0 : index[i] >= kResidualBins ? kResidualBins - 1 : index[i]];
}

// Student's t with five degrees of freedom, as in Kerl et al. 2013.
static inline Lanes robust_weight(Lanes squared) { return 6.0f / (5.0f + squared); }

// What the frame shows at eight positions: eight lanes each of its layers.
static inline void sample(const float* layers, int width, Lanes u, Lanes v, IntLanes inside, Lanes* sampled) {
  const IntLanes column = __builtin_convertvector(keep(inside, u), IntLanes);
  const IntLanes row = __builtin_convertvector(keep(inside, v), IntLanes);
  const Lanes right = u - __builtin_convertvector(column, Lanes), below = v - __builtin_convertvector(row, Lanes);
  for (int i = 0; i < 8; ++i) {
    if (!inside[i]) {
      sampled[i] = Lanes{};
      continue;
    }
    const float* at = layers + (std::size_t(row[i]) * width + column[i]) * kLayers;
    const float* under = at + std::size_t(width) * kLayers;
    const Lanes upper = load(at) * (1.0f - right[i]) + load(at + kLayers) * right[i];
    const Lanes lower = load(under) * (1.0f - right[i]) + load(under + kLayers) * right[i];
    sampled[i] = upper * (1.0f - below[i]) + lower * below[i];
  }
  transpose(sampled);
}

// [6] change of an image's value under points, by a twist of the points in front of the camera.
static inline void slopes_by_twist(Lanes a, Lanes b, Lanes x, Lanes y, Lanes z, Lanes inverse_z, Lanes* slopes) {
  const Lanes c = -(a * x + b * y) * inverse_z;
  slopes[0] = a, slopes[1] = b, slopes[2] = c;
  slopes[3] = c * y - b * z, slopes[4] = a * z - c * x, slopes[5] = b * x - a * y;
}

// Eight points of the reference where the frame would show them.
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

static void align(const float* brightness, const float* depth, const Camera& camera, int begin, int end,
                  const float* layers, const Pose& light_motion, const Pose& depth_motion,
                  const AlignmentSettings& settings, AlignmentSums& sums, ResidualHistogram& histogram) {
  const Lanes nan = splat(__builtin_nanf(""));
  const bool is_split = __builtin_memcmp(&light_motion, &depth_motion, sizeof(Pose)) != 0;
  for (int row = begin; row < end; ++row) {
    Lanes H[kUnknowns * (kUnknowns + 1) / 2] = {}, g[kUnknowns] = {}, cost{};
    const float ray_y = (row - camera.cy) / camera.fy;
    for (int first = 0; first < camera.width; first += 8) {
      const int columns = camera.width - first < 8 ? camera.width - first : 8;
      const std::size_t at = std::size_t(row) * camera.width + first;
      Lanes light = nan, range = nan;
      __builtin_memcpy(&light, brightness + at, sizeof(float) * columns);
      __builtin_memcpy(&range, depth + at, sizeof(float) * columns);
      const IntLanes known = range > 0.0f;  // NaN is not
      const int points = count(known);
      if (points == 0) continue;
      sums.points += points;
      const Lanes px = (iota() + (float(first) - camera.cx)) / camera.fx * range, py = ray_y * range;
      const Moved d = moved(depth_motion, px, py, range, known, camera);
      Lanes frame[kLayers];
      sample(layers, camera.width, d.u, d.v, d.inside, frame);
      Lanes depth_residual = (frame[3] - d.z) * d.inverse_z;
      sums.compared += count(d.inside & (frame[3] == frame[3]));
      IntLanes seen = d.inside & (absolute(depth_residual) < settings.max_depth_ratio);  // NaN is not
      Lanes by_light[kUnknowns], by_depth[6];
      const Lanes tilt_x = frame[4] * camera.fx * d.inverse_z, tilt_y = frame[5] * camera.fy * d.inverse_z;
      const Lanes upright = 1.0f / sqrt(1.0f + tilt_x * tilt_x + tilt_y * tilt_y);
      slopes_by_twist(tilt_x, tilt_y, d.x, d.y, d.z, d.inverse_z, by_depth);
      by_depth[2] -= 1.0f;
      by_depth[3] -= d.y;
      by_depth[4] += d.x;
      const Moved l = is_split ? moved(light_motion, px, py, range, known, camera) : d;
      if (is_split) {
        seen &= l.inside;
        sample(layers, camera.width, l.u, l.v, seen, frame);
      }
      sums.seen += count(seen);
      Lanes light_residual = keep(seen, frame[0] - (settings.gain * light + settings.bias));
      depth_residual = keep(seen, depth_residual * upright);
      tally(histogram.light, light_residual, seen);
      tally(histogram.depth, depth_residual, seen);
      sums.agreeing += count(seen & (absolute(light_residual) <= settings.inlier_light) &
                             (absolute(depth_residual) <= settings.inlier_depth));

      slopes_by_twist(frame[1] * camera.fx * l.inverse_z, frame[2] * camera.fy * l.inverse_z, l.x, l.y, l.z, l.inverse_z,
                      by_light);
      by_light[6] = -light;
      by_light[7] = splat(-1.0f);
      by_light[8] = Lanes{};
      for (int i = 0; i < 6; ++i) by_light[8] += by_light[i] * settings.velocity[i];
      for (int i = 0; i < kUnknowns; ++i) by_light[i] = keep(seen, by_light[i]);
      for (int i = 0; i < 6; ++i) by_depth[i] = keep(seen, by_depth[i] * d.inverse_z * upright);

      const float light_precision = 1.0f / (settings.light_scale * settings.light_scale);
      const float depth_precision = 1.0f / (settings.depth_scale * settings.depth_scale);
      const Lanes light_squared = light_residual * light_residual * light_precision;
      const Lanes depth_squared = depth_residual * depth_residual * depth_precision;
      const Lanes light_weight = robust_weight(light_squared) * light_precision;
      const Lanes depth_weight = robust_weight(depth_squared) * depth_precision;
      cost += keep(seen, light_squared / (5.0f + light_squared) + depth_squared / (5.0f + depth_squared));
      int entry = 0;
      for (int i = 0; i < kUnknowns; ++i) {
        const Lanes weighted_light = by_light[i] * light_weight;
        if (i < 6) {
          const Lanes weighted_depth = by_depth[i] * depth_weight;
          g[i] += weighted_light * light_residual + weighted_depth * depth_residual;
          for (int k = i; k < 6; ++k) H[entry++] += weighted_light * by_light[k] + weighted_depth * by_depth[k];
          for (int k = 6; k < kUnknowns; ++k) H[entry++] += weighted_light * by_light[k];
        } else {
          g[i] += weighted_light * light_residual;
          for (int k = i; k < kUnknowns; ++k) H[entry++] += weighted_light * by_light[k];
        }
      }
    }
    for (int i = 0; i < kUnknowns * (kUnknowns + 1) / 2; ++i) sums.H[i] += sum(H[i]);
    for (int i = 0; i < kUnknowns; ++i) sums.g[i] += sum(g[i]);
    sums.cost += sum(cost);
  }
}
