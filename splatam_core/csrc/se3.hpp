// Rigid motions, as splatam_core/geometry/se3.py has them.
#pragma once

#include <algorithm>
#include <cmath>

namespace splatam {

using Vector3 = double[3];
using Twist = double[6];  // translation, rotation

// The upper three rows of a motion.
struct Motion {
  double R[3][3], t[3];
};

inline void cross(const double* a, const double* b, double* product) {
  product[0] = a[1] * b[2] - a[2] * b[1], product[1] = a[2] * b[0] - a[0] * b[2],
  product[2] = a[0] * b[1] - a[1] * b[0];
}

// Returns the motion a * b.
inline Motion operator*(const Motion& a, const Motion& b) {
  Motion product;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column)
      product.R[row][column] =
          a.R[row][0] * b.R[0][column] + a.R[row][1] * b.R[1][column] + a.R[row][2] * b.R[2][column];
    product.t[row] = a.R[row][0] * b.t[0] + a.R[row][1] * b.t[1] + a.R[row][2] * b.t[2] + a.t[row];
  }
  return product;
}

// Returns the motion of a twist.
inline Motion exp(const Twist& twist) {
  const double *rho = twist, x = twist[3], y = twist[4], z = twist[5];
  const double squared = x * x + y * y + z * z, angle = std::sqrt(squared);
  double a = 1.0 - squared / 6, b = 0.5 - squared / 24, c = 1.0 / 6 - squared / 120;
  if (angle >= 1e-5)  // below, the closed forms lose all digits
    a = std::sin(angle) / angle, b = (1 - std::cos(angle)) / squared, c = (angle - std::sin(angle)) / (squared * angle);
  Vector3 turned, twice;
  cross(twist + 3, rho, turned), cross(twist + 3, turned, twice);
  Motion motion{{{1 + b * (x * x - squared), b * x * y - a * z, b * x * z + a * y},
                 {b * x * y + a * z, 1 + b * (y * y - squared), b * y * z - a * x},
                 {b * x * z - a * y, b * y * z + a * x, 1 + b * (z * z - squared)}},
                {}};
  for (int i = 0; i < 3; ++i) motion.t[i] = rho[i] + b * turned[i] + c * twice[i];
  return motion;
}

// Writes the axis times the angle, in [0, pi], of a rotation (by a quaternion from the largest pivot, Shepperd 1978).
inline void rotation_vector(const double (&R)[3][3], double* axis) {
  const double pivots[4] = {R[0][0] + R[1][1] + R[2][2], R[0][0], R[1][1], R[2][2]};
  const int k = int(std::max_element(pivots, pivots + 4) - pivots);
  double q[4] = {1 + pivots[0], R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]};
  if (k > 0) {
    const int i = k - 1, j = k % 3, m = (k + 1) % 3;
    q[0] = R[m][j] - R[j][m];
    q[1 + i] = 1 + R[i][i] - R[j][j] - R[m][m], q[1 + j] = R[j][i] + R[i][j], q[1 + m] = R[m][i] + R[i][m];
  }
  const double length = std::copysign(std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), q[0]);
  for (double& value : q) value /= length;
  const double sine = std::sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const double factor = sine < 1e-12 ? 2.0 : 2.0 * std::atan2(sine, q[0]) / sine;
  for (int i = 0; i < 3; ++i) axis[i] = factor * q[1 + i];
}

// Writes the twist whose exp() is a motion.
inline void log(const Motion& motion, Twist& twist) {
  double* phi = twist + 3;
  rotation_vector(motion.R, phi);
  const double angle = std::sqrt(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]), half = angle / 2;
  const double c = angle < 1e-5 ? 1.0 / 12 + angle * angle / 720 : (1 - half / std::tan(half)) / (angle * angle);
  Vector3 turned, twice;
  cross(phi, motion.t, turned), cross(phi, turned, twice);
  for (int i = 0; i < 3; ++i) twist[i] = motion.t[i] - 0.5 * turned[i] + c * twice[i];
}

}  // namespace splatam
