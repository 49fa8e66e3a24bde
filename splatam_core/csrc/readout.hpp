// A rolling shutter: the rows of an image are read one after the other, while the camera moves.
#pragma once

#include "kernels.hpp"

namespace splatam {

// Returns when a row is read: from -0.5 for the first to 0.5 for the last.
inline float time_of_row(int row, int height) { return height > 1 ? float(row) / float(height - 1) - 0.5f : 0.0f; }

// The motion of a camera while an image is read.
class Readout {
 public:
  // twist: from the first row to the last.
  explicit Readout(const float* twist) {
    for (int i = 0; i < 3; ++i) v_[i] = twist[i], w_[i] = twist[3 + i];
    for (int i = 0; i < 6; ++i) moves_ = moves_ || twist[i] != 0.0f;
  }

  // Returns a pose at another time: exp(time * twist) * pose to second order. What is left out is 0.02 pixels in a turn
  // of 3 degrees.
  Pose at(const Pose& pose, float time) const {
    if (!moves_) return pose;
    Pose moved;
    for (int column = 0; column < 3; ++column) {
      const float axis[3] = {pose.R[column], pose.R[3 + column], pose.R[6 + column]};
      float turned[3];
      carry(axis, 0.0f, time, turned);
      for (int row = 0; row < 3; ++row) moved.R[3 * row + column] = turned[row];
    }
    carry(pose.t, 1.0f, time, moved.t);
    return moved;
  }

 private:
  // Moves a point, or turns a direction, of which `is_point` is 0.
  void carry(const float* from, float is_point, float time, float* to) const {
    float speed[3], change[3];
    rate(from, is_point, speed), rate(speed, 0.0f, change);
    for (int i = 0; i < 3; ++i) to[i] = from[i] + time * (speed[i] + 0.5f * time * change[i]);
  }

  void rate(const float* p, float is_point, float* speed) const {
    speed[0] = w_[1] * p[2] - w_[2] * p[1] + is_point * v_[0];
    speed[1] = w_[2] * p[0] - w_[0] * p[2] + is_point * v_[1];
    speed[2] = w_[0] * p[1] - w_[1] * p[0] + is_point * v_[2];
  }

  float v_[3], w_[3];
  bool moves_ = false;
};

}  // namespace splatam
