// The inner loops, compiled once per instruction set and chosen at run time.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatam {

constexpr int kTile = 8;           // pixels on a side
constexpr float kNear = 0.2f;      // metres
constexpr float kBlur = 0.3f;      // px^2
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinAlpha = 1.0f / 255.0f;
constexpr float kMinTransmittance = 1e-4f;

struct Camera {
  int width, height;
  float fx, fy, cx, cy;
  float focal() const { return 0.5f * (fx + fy); }
};

struct Pose {  // world to camera
  float R[9], t[3];
};

// A Gaussian on the image. alpha(d) = opacity exp(falloff d^2).
struct Splat {
  float u, v, falloff, opacity, r, g, b, z;
};

// The tiles that a splat's disc touches: columns x0..x1, rows y0..y1, less the corners (top left, top right, bottom
// left, bottom right: bits 0 to 3) that the disc misses.
struct TileRect {
  std::uint16_t x0, y0, x1, y1 : 12, missed_corners : 4;
};
constexpr int kMaxTiles = 1 << 12;  // per side

// Sums over pixels of dL/d(log alpha) times 1, dx, dy, d^2, and of dL/d(r, g, b, z).
struct SplatGradient {
  float log_alpha, dx, dy, squared, r, g, b, z;
};

struct GaussianArrays {
  const float *means, *log_scales, *logit_opacities, *rgb;
};

struct Images {  // planar, width * height each; rgb three planes
  float *rgb, *depth, *silhouette;
};

struct ConstImages {
  const float *rgb, *depth, *silhouette;
};

struct TileList {
  int x, y;  // pixel of its upper left corner
  const std::uint32_t* splats;
  std::size_t count;
};

struct Kernels {
  // Projects Gaussians [begin, end); writes the visible ones to splats, rects and ids, from `begin` on.
  // Returns how many are visible.
  std::size_t (*project)(const GaussianArrays&, const Camera&, const Pose&, std::size_t begin, std::size_t end,
                         Splat* splats, TileRect* rects, std::uint32_t* ids);
  void (*forward)(const TileList&, const Splat*, const Camera&, const Images&);
  // Adds to gradients. Without `map`, the colour gradients stay as they are.
  void (*backward)(const TileList&, const Splat*, const Camera&, const ConstImages& drawn, const ConstImages& gradient,
                   bool map, SplatGradient* gradients);
  const char* name;
};

const Kernels& kernels_generic();
#if defined(__x86_64__)
const Kernels& kernels_avx2();
const Kernels& kernels_avx512();
#endif

// The fastest that this processor runs; SPLATAM_ISA=generic|avx2|avx512 lowers the choice.
const Kernels& best_kernels();

}  // namespace splatam
