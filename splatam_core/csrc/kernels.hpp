// The inner loops. They are compiled once per instruction set and chosen at run time.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatam {

constexpr int kTile = 8;       // pixels on a side
constexpr float kNear = 0.2f;  // metres
constexpr float kBlur = 0.3f;  // px^2
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

// A projected Gaussian: alpha(d) = opacity exp(falloff d^2) at d pixels from (u, v).
template <typename Value>
struct BasicSplat {
  Value u, v, falloff, opacity, r, g, b, z;
};
using Splat = BasicSplat<float>;

// The tiles that a splat's disc touches: columns x0..x1 and rows y0..y1, without the corners that the disc misses (bits
// 0 to 3: top left, top right, bottom left, bottom right).
struct TileRect {
  std::uint16_t x0, y0, x1, y1 : 12, missed_corners : 4;
};
constexpr int kMaxTiles = 1 << 12;  // per side
constexpr int kMaxSide = kMaxTiles * kTile;

// Entries of all tile lists of a view, 4 bytes each. A map of a million Gaussians that cover 60 tiles each is below it.
constexpr std::size_t kMaxEntries = std::size_t(1) << 26;

// Values beyond this, and those that are not finite, are no Gaussian's: it is not drawn, and a step there is not taken.
constexpr float kHuge = 1e30f;

// Sums over pixels of dL/d(log alpha) times 1, dx, dy, d^2, and of dL/d(r, g, b, z).
template <typename Value>
struct BasicSplatGradient {
  Value log_alpha, dx, dy, squared, r, g, b, z;
};
using SplatGradient = BasicSplatGradient<float>;

// The gradient by a Gaussian's parameters.
template <typename Value>
struct GaussianGradient {
  Value camera[3];  // by the centre in camera coordinates
  Value log_scale, logit_opacity;
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

struct MutableGaussians {
  float *means, *log_scales, *logit_opacities, *rgb;
};

struct MapGradients {  // null where a gradient is not wanted
  float *means, *log_scales, *logit_opacities, *rgb;
};

// The images that a view is fitted to, and the weights of a difference per pixel and channel.
struct Target {
  const std::uint8_t* rgb;  // [H, W, 3]
  const float* depth;       // [H, W] metres, 0 = no reading, negative = the pixel is not compared
  float color_weight, depth_weight;
  float color_limit, depth_limit;  // up to here Huber's loss is quadratic
  float enough;                    // tiles with less loss per pixel give no gradients
};

// Adam (Kingma and Ba 2015) with Nesterov's momentum (Dozat 2016). A Gaussian's values in this order: mean, log scale,
// logit opacity, rgb.
struct AdamState {
  float* moments;       // [N, 16]: first moments, then second
  std::uint8_t* steps;  // [N], counts to 255
};

struct AdamRates {
  float means, log_scales, logit_opacities, rgb;
};

// Memory of a tile whose splats are gone through twice, in floats.
constexpr std::size_t kPart = 2048;            // splats of which everything is kept at once
constexpr std::size_t kScratchPerSplat = 129;  // alpha and weight in each pixel of a tile, and where it is seen
constexpr std::size_t kScratchPerPart = 64;    // transmittance in each pixel of a tile
constexpr std::size_t kScratchAlignment = 64;  // bytes

inline std::size_t parts_of(std::size_t count) { return (count + kPart - 1) / kPart; }

inline std::size_t scratch_of(std::size_t count) {
  return kScratchPerPart * parts_of(count) + kScratchPerSplat * (count < kPart ? count : kPart);
}

struct TileList {
  int x, y;  // pixel of its upper left corner
  const std::uint32_t* splats;
  std::size_t count;
};

// Layers of an image that is aligned: brightness, its gradients along u and v, depth in metres, its gradients, and two
// of padding, so that a pixel fills a vector. NaN depth marks pixels that are not on a surface.
constexpr int kLayers = 8;

// The sums of the linearised residuals of an alignment. Unknowns: the twist (6), gain and bias of the brightness, and
// the time offset between colour and depth.
constexpr int kUnknowns = 9;
struct AlignmentSums {
  double H[kUnknowns * (kUnknowns + 1) / 2];  // upper triangle, row by row
  double g[kUnknowns];
  double cost;  // of the seen points; each residual adds less than one
  // Points with depth; of these, points that project onto a depth reading of the frame; of these, points on the same
  // surface (seen); of these, points whose residuals are inliers.
  std::int64_t points, compared, seen, agreeing;
};

struct AlignmentSettings {
  float gain, bias;   // brightness of the frame = gain * brightness of the reference + bias
  float velocity[6];  // twist per frame interval: how the pose at the colour image's time changes with the time offset
  float photometric_scale, depth_scale;  // of the residuals; that of depth is relative to the depth
  float max_depth_ratio;                 // points that differ by more are on another surface
  float inlier_color, inlier_depth;      // largest residuals of an inlier
};

// Histogram of the absolute residuals, for their median. A bin is an eighth of an octave.
constexpr int kResidualBins = 1024;
struct ResidualHistogram {
  std::uint32_t photometric[kResidualBins], depth[kResidualBins];
};

struct Kernels {
  // Projects Gaussians [begin, end); writes the visible ones to splats, rects and ids, from `begin` on.
  // Returns how many are visible.
  std::size_t (*project)(const GaussianArrays&, const Camera&, const Pose&, std::size_t begin, std::size_t end,
                         Splat* splats, TileRect* rects, std::uint32_t* ids);
  void (*forward)(const TileList&, const Splat*, const Camera&, const Images&);
  // Adds to the gradients. Skips those by the colours unless `map` is set. `scratch` is memory of scratch_of(count
  // of the list) floats, aligned to kScratchAlignment.
  void (*backward)(const TileList&, const Splat*, const Camera&, const ConstImages& gradient, bool map, float* scratch,
                   SplatGradient* gradients);
  // Blends a tile, compares it with the target (Huber) and adds the gradients. Returns the tile's loss. `scratch` is as
  // in `backward`.
  double (*fit)(const TileList&, const Splat* splats, const Camera&, const Target&, float* scratch,
                SplatGradient* gradients);

  // Writes the gradients of `count` splats by the Gaussians ids[i], where they are wanted, and adds those by the upper
  // three rows of the pose.
  void (*project_back)(const Splat*, const std::uint32_t* ids, const SplatGradient*, std::size_t count, const Camera&,
                       const Pose&, const float* means, const MapGradients&, double* pose_gradient);

  // Takes an Adam step of the Gaussians ids[i] of `count` splats that have gradients. Extends the bounds of their
  // block.
  void (*update)(const Splat* splats, const std::uint32_t* ids, const SplatGradient* gradients, std::size_t count,
                 const Camera&, const Pose&, const MutableGaussians&, const AdamState&, const AdamRates&,
                 float* bounds);

  // Linearises the residuals of rows [begin, end) of a reference [H, W] in a frame, and counts the inliers. The frame's
  // colour may have been taken at another time than its depth, so each has its own camera motion.
  void (*align)(const float* brightness, const float* depth, const Camera&, int begin, int end, const float* layers,
                const Pose& color_motion, const Pose& depth_motion, const AlignmentSettings&, AlignmentSums&,
                ResidualHistogram&);

  const char* name;
};

const Kernels& kernels_generic();
#if defined(__x86_64__)
const Kernels& kernels_avx2();
const Kernels& kernels_avx512();
#endif

// Returns the kernels of the best instruction set that this processor has. SPLATAM_ISA=generic|avx2|avx512 limits the
// choice; another value is std::invalid_argument.
const Kernels& best_kernels();

}  // namespace splatam
