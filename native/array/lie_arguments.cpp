#include "array/lie_arguments.h"

#include <cstdio>

namespace armlab {
namespace {

std::string number(const char *format, double x) {
  char text[32];
  std::snprintf(text, sizeof text, format, x);
  return text;
}

npy_intp count(const Samples &samples) {
  return samples.size() / std::max(samples.samples().width, 1);
}

std::string indexed(const Samples &samples, const std::string &name, npy_intp k) {
  return place(name, k, samples.shape(), samples.batch_axes());
}

bool any_missing(const double *m, int stride) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      if (std::isnan(m[stride * i + j])) return true;
  return false;
}

// The reason why a matrix is not a rotation; empty if it is one.
std::string fault(const double *m, int stride) {
  if (any_missing(m, stride)) return "";
  const Rotation<double> R = rotation_at(m, stride);
  double largest = 0.0;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) largest = std::max(largest, std::fabs(m[stride * i + j]));
  if (std::isinf(largest)) return "max|R| = inf";
  const double off = departure(R);
  if (off > rotation_tolerance) return "max|R^T R - I| = " + number("%.3g", off);
  const double determinant = dot(cross(R.x, R.y), R.z);
  return determinant < 0.0 ? "determinant = " + number("%.3g", determinant) : "";
}

}  // namespace

double departure(const Rotation<double> &R) {
  const Vec3<double> columns[3] = {R.x, R.y, R.z};
  double off = 0.0;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j)
      off = std::max(off, std::fabs(dot(columns[i], columns[j]) - (i == j)));
  return off;
}

void restore_digits(Input &matrices) {
  const int stride = static_cast<int>(matrices.shape()[matrices.ndim() - 1]),
            width = stride * stride;
  double *copy = nullptr;
  for (npy_intp k = 0; k < matrices.size() / width; ++k) {
    const double *m = matrices.data() + width * k;
    Rotation<double> R = rotation_at(m, stride);
    const double off = departure(R);
    if (any_missing(m, stride) || off <= negligible || off > rotation_tolerance) continue;
    if (!copy) copy = numbers(matrices.copy());
    for (int step = 0; step < 2; ++step) {  // Newton: R (3 I - R^T R) / 2, error 1e-5, 1e-10, 1e-20
      const Vec3<double> x = R.x, y = R.y, z = R.z;
      const double xx = dot(x, x), yy = dot(y, y), zz = dot(z, z);
      const double xy = 0.5 * dot(x, y), xz = 0.5 * dot(x, z), yz = 0.5 * dot(y, z);
      R.x = (1.5 - 0.5 * xx) * x - xy * y - xz * z;
      R.y = (1.5 - 0.5 * yy) * y - xy * x - yz * z;
      R.z = (1.5 - 0.5 * zz) * z - xz * x - yz * y;
    }
    R.write(copy + width * k, stride);
  }
}

void refuse_no_rotation(const Samples &R, const std::string &name, int stride) {
  for (npy_intp k = 0; k < count(R); ++k) {
    const std::string came = fault(R.data() + k * R.samples().width, stride);
    if (!came.empty())
      raise_shape_error(
          "Expected " + indexed(R, name, k) + " to be a rotation within " +
          number("%g", rotation_tolerance) + ", got " + came +
          ". Project it first if that is intended (lie.so3.project, lie.se3.project).");
  }
}

void refuse_no_pose(const Samples &T, const std::string &name) {
  refuse_no_rotation(T, "the rotation of " + name, 4);
  for (npy_intp k = 0; k < count(T); ++k) {
    const double *m = T.data() + 16 * k;
    double off = 0.0;
    for (int j = 12; j < 16; ++j) {
      const double error = std::fabs(m[j] - (j == 15));
      off = error <= off || std::isnan(off) ? off : error;
    }
    if (off > 0.0 || (std::isnan(off) && !any_missing(m, 4)))  // a NaN only here would be lost
      raise_shape_error("Expected (0, 0, 0, 1) as the last row of " + indexed(T, name, k) +
                        ", got an error of " + number("%.3g", off) + ".");
  }
}

void refuse_not_unit(const Samples &q) {
  for (npy_intp k = 0; k < count(q); ++k) {
    const double *c = q.data() + 4 * k,
                 length = std::hypot(std::hypot(c[0], c[1]), std::hypot(c[2], c[3]));
    if (std::fabs(length - 1.0) > unit_tolerance)
      raise_shape_error("Expected " + indexed(q, q.name(), k) + " of length 1 within " +
                        number("%g", unit_tolerance) + " (wxyz), got length " +
                        number("%.6g", length) + ".");
  }
}

}  // namespace armlab
