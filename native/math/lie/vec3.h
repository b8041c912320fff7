// Three-vectors and poses over Real (double or Lanes).
#pragma once

#include "math/lie/sincos.h"

namespace armlab {

template <class Real>
struct Vec3 {
  Real x, y, z;

  // Reads three numbers that are `stride` apart in memory.
  static Vec3 read(const Real *m, int stride = 1) { return {m[0], m[stride], m[2 * stride]}; }
  void write(Real *m, int stride = 1) const {
    m[0] = x;
    m[stride] = y;
    m[2 * stride] = z;
  }
};

template <class Real>
inline Vec3<Real> operator+(const Vec3<Real> &a, const Vec3<Real> &b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class Real>
inline Vec3<Real> operator-(const Vec3<Real> &a, const Vec3<Real> &b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class Real>
inline Vec3<Real> operator-(const Vec3<Real> &a) {
  return {-a.x, -a.y, -a.z};
}
template <class Real>
inline Vec3<Real> operator*(const Real &s, const Vec3<Real> &a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class Real>
inline Real dot(const Vec3<Real> &a, const Vec3<Real> &b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class Real>
inline Vec3<Real> cross(const Vec3<Real> &a, const Vec3<Real> &b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// T_a_b by columns: the axes and the origin of frame b in frame a.
template <class Real>
struct Pose {
  Vec3<Real> x, y, z, p;

  Pose() = default;
  Pose(const Vec3<Real> &x_, const Vec3<Real> &y_, const Vec3<Real> &z_, const Vec3<Real> &p_)
      : x(x_), y(y_), z(z_), p(p_) {}
  explicit Pose(const double *m)  // (4, 4), row by row
      : x{m[0], m[4], m[8]}, y{m[1], m[5], m[9]}, z{m[2], m[6], m[10]}, p{m[3], m[7], m[11]} {}

  Vec3<Real> turn(const Vec3<Real> &b) const { return b.x * x + b.y * y + b.z * z; }  // R b
  // R^T a
  Vec3<Real> turn_back(const Vec3<Real> &a) const { return {dot(x, a), dot(y, a), dot(z, a)}; }

  void write(Real *m) const {
    const Vec3<Real> *columns[4] = {&x, &y, &z, &p};
    for (int k = 0; k < 4; ++k) {
      columns[k]->write(m + k, 4);
      m[12 + k] = Real(k == 3 ? 1.0 : 0.0);
    }
  }
};

template <class Real>
inline Pose<Real> operator*(const Pose<Real> &a, const Pose<Real> &b) {
  return {a.turn(b.x), a.turn(b.y), a.turn(b.z), a.p + a.turn(b.p)};
}

}  // namespace armlab
