// Euler angles about any three axes. Exact values: tests/numerics/tables/groups.json.
#pragma once

#include "math/lie/lie.h"

namespace armlab {

// The axes by index, R = R_first(r) R_middle(p) R_last(y); neighbours differ.
struct Axes {
  int first, middle, last;
};

constexpr double gimbal_lock = 1e-13;  // below it, the first and last axes count as parallel

// atan2(y, x), with atan2(0, 0) = 0; a rotation by pi is +pi for either sign of zero.
template <class Real>
inline Real angle_of(const Real &y, const Real &x) {
  constexpr Real pi(0x1.921fb54442d18p1);
  const Real zero(0.0), y_size = select(y < zero, -y, y), x_size = select(x < zero, -x, x);
  const auto nowhere = (y == zero) & (x == zero);
  const Real steep = quadrant_angle(y_size, select(nowhere, Real(1.0), x_size));
  const Real size = select(x < zero, pi - steep, steep);
  return select(y < zero, -size, size);
}

// m <- m R, with R the rotation about an axis.
template <class Real>
inline void turn_on(Real *m, int axis, const Real &angle) {
  const int j = (axis + 1) % 3, k = (axis + 2) % 3;
  Real s, c;
  sincos(angle, s, c);
  for (int row = 0; row < 9; row += 3) {
    const Real a = m[row + j], b = m[row + k];
    m[row + j] = a * c + b * s;
    m[row + k] = b * c - a * s;
  }
}

template <class Real>
inline void matrix_from_angles(const Real *rpy, const Axes &axes, Real *m) {
  for (int i = 0; i < 9; ++i) m[i] = Real(i % 4 ? 0.0 : 1.0);
  turn_on(m, axes.first, rpy[0]);
  turn_on(m, axes.middle, rpy[1]);
  turn_on(m, axes.last, rpy[2]);
}

template <class Real>
inline void angles_from_matrix(const Real *m, const Axes &axes, Real *rpy) {
  const int i = axes.first, j = axes.middle, k = 3 - i - j;
  const bool proper = axes.last == i;
  const Real e((j - i + 3) % 3 == 1 ? 1.0 : -1.0);  // e_i x e_j = e e_k
  // The last axis, as rotated by the first two rotations.
  const Real sine = proper ? m[3 * j + i] : -e * m[3 * j + k];
  const Real cosine = proper ? -e * m[3 * k + i] : m[3 * k + k];
  const Real length = square_root(sine * sine + cosine * cosine);
  const Real first = select(length < Real(gimbal_lock), Real(0.0), angle_of(sine, cosine));
  // Row j without the first rotation contains only the last one, so gimbal lock does not affect it.
  Real s, c, row[3];
  sincos(first, s, c);
  for (int column = 0; column < 3; ++column)
    row[column] = c * m[3 * j + column] + e * s * m[3 * k + column];
  rpy[0] = first;
  rpy[1] = proper ? angle_of(length, m[3 * i + i]) : angle_of(e * m[3 * i + k], length);
  rpy[2] = angle_of(proper ? -e * row[k] : e * row[i], row[j]);
}

}  // namespace armlab
