// What the residuals of an alignment say about its pose: the sums that splatam_core/tracking/evidence.py judges.
#pragma once

#include "kernels.hpp"

namespace splatam {

constexpr int kCellRows = 6, kCellColumns = 8, kCells = kCellRows * kCellColumns;

// Two images of the same camera, and where an alignment of them ended.
struct Aligned {
  const float *brightness, *depth;  // of the reference, [H, W]
  const float* layers;              // of the frame, [H, W, kLayers]
  Camera camera;
  Pose color_motion, depth_motion;
  AlignmentSettings settings;
  float readout[6];       // twist of the camera from the first row of an image to its last
  float max_depth_error;  // relative, of a reading that is near the map
  int step;               // every n-th pixel of every n-th row is compared
};

// Sums over the points of a cell, in the order of the fields.
struct CellSums {
  double lit, met, near, expected, found, expected_squared, found_squared, product, difference;
};
constexpr int kCellSums = int(sizeof(CellSums) / sizeof(double));

struct EvidenceSums {
  double claimed[kUnknowns][kUnknowns];  // products of the derivatives that the frame's gradients give
  double shared[kUnknowns][kUnknowns];   // of those that the reference's gradients give with those
  double scores[kUnknowns][kCellColumns];
  CellSums cells[kCellColumns];
};

// Adds the points of one row of cells.
void sum_evidence(const Aligned&, int cell_row, EvidenceSums&);

}  // namespace splatam
