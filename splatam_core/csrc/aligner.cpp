#include "aligner.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "readout.hpp"

namespace splatam {
namespace {

constexpr float kNone = std::numeric_limits<float>::quiet_NaN();
constexpr float kMinSilhouette = 0.5f;  // where less is covered, a render has no depth

float luminance(float red, float green, float blue) { return 0.299f * red + 0.587f * green + 0.114f * blue; }
constexpr int kRowsPerPiece = 16;  // of an image, or columns

int pieces_of(int rows) { return (rows + kRowsPerPiece - 1) / kRowsPerPiece; }

// Returns the upper edge of the bin that holds the median; tally() defines the bins.
float median(const std::uint32_t* bins) {
  std::uint64_t total = 0, below = 0;
  for (int bin = 0; bin < kResidualBins; ++bin) total += bins[bin];
  if (total == 0) return kNone;
  int bin = 0;
  while (2 * (below + bins[bin]) < total) below += bins[bin++];
  const std::uint32_t bits = std::uint32_t(bin + 1 + ((127 - 64) << 3)) << 20;
  float edge;
  std::memcpy(&edge, &bits, sizeof edge);
  return edge;
}

void add(AlignmentSums& total, const AlignmentSums& part) {
  for (int i = 0; i < kUnknowns * (kUnknowns + 1) / 2; ++i) total.H[i] += part.H[i];
  for (int i = 0; i < kUnknowns; ++i) total.g[i] += part.g[i];
  total.cost += part.cost;
  total.points += part.points, total.compared += part.compared;
  total.seen += part.seen, total.agreeing += part.agreeing;
}

void add(Aligner::RowMoments& total, const AlignmentSums& row, double time) {
  for (int i = 0; i < kUnknowns * (kUnknowns + 1) / 2; ++i)
    total.H1[i] += time * row.H[i], total.H2[i] += time * time * row.H[i];
  for (int i = 0; i < kUnknowns; ++i) total.g1[i] += time * row.g[i];
}

void add(Aligner::RowMoments& total, const Aligner::RowMoments& part) {
  for (int i = 0; i < kUnknowns * (kUnknowns + 1) / 2; ++i) total.H1[i] += part.H1[i], total.H2[i] += part.H2[i];
  for (int i = 0; i < kUnknowns; ++i) total.g1[i] += part.g1[i];
}

// See Aligner::frame_images; `lines` rows or columns next to each other of count pixels, which are stride floats apart.
// They are filled side by side: along a column, each pixel is in another line of the cache.
void fill_lines(float* first, int lines, std::size_t apart, int count, std::size_t stride, int max_gap,
                float max_step) {
  int before[kRowsPerPiece];
  std::fill_n(before, lines, -1);
  for (int i = 0; i < count; ++i)
    for (int line = 0; line < lines; ++line) {
      float* values = first + line * apart;
      const float far_side = values[i * stride];
      if (!(far_side > 0.0f)) continue;  // NaN is none
      const int last = before[line], gap = i - last - 1;
      before[line] = i;
      if (last < 0 || gap == 0 || gap > max_gap) continue;
      const float near_side = values[last * stride];
      if (!(std::fabs(far_side - near_side) <= max_step * std::min(near_side, far_side))) continue;
      for (int k = 1; k <= gap; ++k) {
        const float t = float(k) / float(gap + 1);
        values[(last + k) * stride] = 1.0f / ((1.0f - t) / near_side + t / far_side);
      }
    }
}

}  // namespace

// Calls task(piece, worker, begin, end) for rows [begin, end), piece by piece.
template <typename Task>
void Aligner::for_rows(int rows, const Task& task) {
  pool_.run(threads_, std::size_t(pieces_of(rows)), [&](std::size_t piece, int worker) {
    const int begin = int(piece) * kRowsPerPiece;
    task(int(piece), worker, begin, std::min(rows, begin + kRowsPerPiece));
  });
}

Aligner::Result Aligner::linearize(const Aligned& at) {
  std::vector<AlignmentSums> sums(pieces_of(at.camera.height));  // added in order, because sums of floats depend on it
  std::vector<ResidualHistogram> histograms(threads_);           // counts do not
  std::vector<RowMoments> moments(sums.size());
  const Readout readout(at.readout);
  for_rows(at.camera.height, [&](int piece, int worker, int begin, int end) {
    for (int row = begin; row < end; ++row) {
      const float time = time_of_row(row, at.camera.height);
      AlignmentSums of_row{};
      kernels_.align(at.brightness, at.depth, at.camera, row, row + 1, at.layers, readout.at(at.color_motion, time),
                     readout.at(at.depth_motion, time), at.settings, of_row, histograms[worker]);
      add(sums[piece], of_row), add(moments[piece], of_row, time);
    }
  });
  for (std::size_t piece = 1; piece < sums.size(); ++piece) add(sums[0], sums[piece]), add(moments[0], moments[piece]);
  for (int worker = 1; worker < threads_; ++worker)
    for (int bin = 0; bin < kResidualBins; ++bin) {
      histograms[0].photometric[bin] += histograms[worker].photometric[bin];
      histograms[0].depth[bin] += histograms[worker].depth[bin];
    }
  return {sums[0], moments[0], median(histograms[0].photometric), median(histograms[0].depth)};
}

Aligner::Evidence Aligner::evidence(const Aligned& images) {
  std::vector<EvidenceSums> sums(kCellRows);
  pool_.run(threads_, kCellRows, [&](std::size_t row, int) { sum_evidence(images, int(row), sums[row]); });
  Evidence total{};
  for (int row = 0; row < kCellRows; ++row) {
    for (int i = 0; i < kUnknowns; ++i) {
      for (int k = 0; k < kUnknowns; ++k)
        total.claimed[i][k] += sums[row].claimed[i][k], total.shared[i][k] += sums[row].shared[i][k];
      std::copy_n(sums[row].scores[i], kCellColumns, total.scores[i] + row * kCellColumns);
    }
    for (int column = 0; column < kCellColumns; ++column) {
      double of_cell[kCellSums];
      std::memcpy(of_cell, &sums[row].cells[column], sizeof of_cell);
      for (int i = 0; i < kCellSums; ++i) total.cells[i][row * kCellColumns + column] = of_cell[i];
    }
  }
  return total;
}

void Aligner::halve(const float* brightness, const float* depth, int width, int height, float max_step,
                    float* half_brightness, float* half_depth) {
  const int columns = width / 2;
  for_rows(height / 2, [&](int, int, int begin, int end) {
    for (int y = begin; y < end; ++y)
      for (int x = 0; x < columns; ++x) {
        const std::size_t a = std::size_t(2 * y) * width + 2 * x, b = a + width;
        const float z[4] = {depth[a], depth[a + 1], depth[b], depth[b + 1]};
        const float mean = 0.25f * (z[0] + z[1] + z[2] + z[3]);  // NaN if any is
        const float nearest = std::min(std::min(z[0], z[1]), std::min(z[2], z[3]));
        const float farthest = std::max(std::max(z[0], z[1]), std::max(z[2], z[3]));
        half_brightness[y * columns + x] =
            0.25f * (brightness[a] + brightness[a + 1] + brightness[b] + brightness[b + 1]);
        half_depth[y * columns + x] = farthest - nearest <= max_step * mean ? mean : kNone;
      }
  });
}

void Aligner::frame_images(const std::uint8_t* rgb, const float* readings, int width, int height, int max_gap,
                           float max_step, float* brightness, float* depth) {
  for_rows(height, [&](int, int, int begin, int end) {
    for (int y = begin; y < end; ++y) {
      const std::size_t row = std::size_t(y) * width;
      for (std::size_t at = row; at < row + width; ++at) {
        brightness[at] = luminance(rgb[3 * at], rgb[3 * at + 1], rgb[3 * at + 2]) / 255.0f;
        depth[at] = readings[at] > 0.0f ? readings[at] : kNone;
      }
      fill_lines(depth + row, 1, 0, width, 1, max_gap, max_step);
    }
  });
  for_rows(width, [&](int, int, int begin, int end) {
    fill_lines(depth + begin, end - begin, 1, height, std::size_t(width), max_gap, max_step);
  });
}

void Aligner::render_images(const ConstImages& drawn, int width, int height, float threshold, float least,
                            float* brightness, float* depth) {
  const std::size_t plane = std::size_t(width) * height;
  const float least_covered = std::max(threshold, least);
  for_rows(height, [&](int, int, int begin, int end) {
    for (std::size_t at = std::size_t(begin) * width; at < std::size_t(end) * width; ++at) {
      const float silhouette = drawn.silhouette[at];
      brightness[at] = luminance(drawn.rgb[at], drawn.rgb[at + plane], drawn.rgb[at + 2 * plane]) /
                       std::max(silhouette, least_covered);
      depth[at] = silhouette > threshold && silhouette >= kMinSilhouette ? drawn.depth[at] / silhouette : kNone;
    }
  });
}

void Aligner::layers(const float* brightness, const float* depth, int width, int height, float max_step,
                     float* layers) {
  for_rows(height, [&](int, int, int begin, int end) {
    for (int y = begin; y < end; ++y)
      for (int x = 0; x < width; ++x) {
        const std::size_t at = std::size_t(y) * width + x;
        const std::size_t left = x > 0 ? at - 1 : at, right = x + 1 < width ? at + 1 : at;
        const std::size_t above = y > 0 ? at - width : at, below = y + 1 < height ? at + width : at;
        const bool inner = right - left == 2 && below - above == 2 * std::size_t(width);
        float* out = layers + at * kLayers;
        out[0] = brightness[at];
        out[1] = inner ? 0.5f * (brightness[right] - brightness[left]) : 0.0f;
        out[2] = inner ? 0.5f * (brightness[below] - brightness[above]) : 0.0f;
        out[4] = inner ? 0.5f * (depth[right] - depth[left]) : 0.0f;
        out[5] = inner ? 0.5f * (depth[below] - depth[above]) : 0.0f;
        const float limit = max_step * depth[at];
        out[3] = std::fabs(out[4]) <= limit && std::fabs(out[5]) <= limit ? depth[at] : kNone;
        out[6] = out[7] = 0.0f;
      }
  });
}

}  // namespace splatam
