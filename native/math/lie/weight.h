// The most likely turn, mass and bias of a weight that hangs on a sensor, with their covariance. Specification:
// tests/oracles/calibration.py.
#pragma once

#include "array/lie_arguments.h"
#include "math/lie/nearest.h"

namespace armlab {

// Readings at N orientations. R: (N, 3, 3) of the tool; force: (N, 3); weight: (N,), or null for ones; pull: (3,).
struct Weighing {
  const double *R, *force, *weight, *pull;
  std::ptrdiff_t N;
  bool free_mass, biased;
  double mass;  // where it is not free

  int unknowns() const { return 3 + free_mass + 3 * biased; }
};

// Where the results go: see the specification. residuals (N, 3), cov (d, d), products (2, 3, 3), numbers (8,).
struct Weighed {
  double *R, *bias, *residuals, *cov, *products, *numbers;
};

// total += w a b^T, row by row.
inline void add_product(double *total, double w, const Vec3<double> &a, const Vec3<double> &b) {
  const double rows[3] = {w * a.x, w * a.y, w * a.z};
  for (int i = 0; i < 3; ++i) {
    total[3 * i] += rows[i] * b.x;
    total[3 * i + 1] += rows[i] * b.y;
    total[3 * i + 2] += rows[i] * b.z;
  }
}

// C_w = R^T (m^2 (tr H - H))^-1 R of the rotation, 1 / tr H of the mass, and the bias that follows both.
inline void write_covariance(const Weighing &in, const Rotation<double> &R, double m, const double *H, double total,
                             const Vec3<double> &mean, double weights, double *cov) {
  const Vec3<double> x{total - H[0], -H[1], -H[2]}, y{-H[1], total - H[4], -H[5]}, z{-H[2], -H[5], total - H[8]};
  const Vec3<double> yz = cross(y, z), zx = cross(z, x), xy = cross(x, y);
  const double scale = 1.0 / (dot(x, yz) * std::max(m * m, std::numeric_limits<double>::min()));
  const Rotation<double> C = R.inverse() * (Rotation<double>{scale * yz, scale * zx, scale * xy} * R);
  const int d = in.unknowns(), free = 3 + in.free_mass;
  std::fill(cov, cov + d * d, 0.0);
  C.write(cov, d);
  if (in.free_mass) cov[3 * d + 3] = 1.0 / total;
  if (!in.biased) return;
  const double A[3][4] = {{0.0, -m * mean.z, m * mean.y, mean.x},
                          {m * mean.z, 0.0, -m * mean.x, mean.y},
                          {-m * mean.y, m * mean.x, 0.0, mean.z}};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < free; ++j) {
      double sum = 0.0;
      for (int k = 0; k < free; ++k) sum -= A[i][k] * cov[k * d + j];
      cov[(free + i) * d + j] = cov[j * d + free + i] = sum;
    }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      double sum = i == j ? 1.0 / weights : 0.0;
      for (int k = 0; k < free; ++k) sum -= cov[(free + i) * d + k] * A[j][k];
      cov[(free + i) * d + free + j] = sum;
    }
}

// Square roots of the eigenvalues of H, a symmetric matrix of entries of the order of 1, ascending.
inline void write_moved(const double *H, double scale, double *moved) {
  double K[4][4] = {}, V[4][4];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) K[i][j] = scale * H[3 * i + j];
  eigenvectors(K, V);
  for (int i = 0; i < 3; ++i) moved[i] = std::sqrt(std::max(K[i][i], 0.0));
  std::sort(moved, moved + 3);
}

inline void turned_weight(const Weighing &in, const Weighed &out) {
  const Vec3<double> g = vector_at(in.pull);
  const auto weight = [&](std::ptrdiff_t i) { return in.weight ? in.weight[i] : 1.0; };
  double weights = 0.0;
  Vec3<double> h_mean{0.0, 0.0, 0.0}, f_mean{0.0, 0.0, 0.0};
  for (std::ptrdiff_t i = 0; i < in.N; ++i) {
    const Vec3<double> h = Rotation<double>::read(in.R + 9 * i, 3).turn_back(g);
    write(h, out.residuals + 3 * i);  // for a while
    weights += weight(i);
    h_mean = h_mean + weight(i) * h;
    f_mean = f_mean + weight(i) * vector_at(in.force + 3 * i);
  }
  h_mean = (in.biased ? 1.0 / weights : 0.0) * h_mean;
  f_mean = (in.biased ? 1.0 / weights : 0.0) * f_mean;
  double *H = out.products, *S = out.products + 9, F = 0.0;
  std::fill(H, H + 18, 0.0);
  for (std::ptrdiff_t i = 0; i < in.N; ++i) {
    const Vec3<double> h = vector_at<double>(out.residuals + 3 * i) - h_mean, f = vector_at(in.force + 3 * i) - f_mean;
    add_product(H, weight(i), h, h);
    add_product(S, weight(i), h, f);
    F += weight(i) * dot(f, f);
  }
  double sigma[3];
  const Rotation<double> R = nearest_rotation(Rotation<double>::read(S, 3), sigma);
  const double total = H[0] + H[4] + H[8];
  const double along = sigma[0] + sigma[1] + sigma[2], other = sigma[0] + sigma[1] - sigma[2];
  const double m = in.free_mass ? along / total : in.mass, m_other = in.free_mass ? other / total : in.mass;
  double power = 0.0;
  for (std::ptrdiff_t i = 0; i < in.N; ++i) {
    const Vec3<double> h = vector_at<double>(out.residuals + 3 * i) - h_mean, f = vector_at(in.force + 3 * i) - f_mean;
    const Vec3<double> r = f - m * R.turn_back(h);
    power += weight(i) * dot(r, r);
    write(r, out.residuals + 3 * i);
  }
  const Vec3<double> mean = R.turn_back(h_mean);
  R.write(out.R, 3);
  write(f_mean - m * mean, out.bias);
  write_covariance(in, R, m, H, total, mean, weights, out.cov);
  const double other_power = std::max(F - 2.0 * m_other * other + m_other * m_other * total, 0.0);
  const double numbers[5] = {m, m_other, power, other_power, F};
  std::copy(numbers, numbers + 5, out.numbers);
  write_moved(H, 1.0 / (weights * dot(g, g)), out.numbers + 5);
}

}  // namespace armlab
