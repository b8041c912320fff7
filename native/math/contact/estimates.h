// What the estimators of a wrench share at the binding: their arguments, their results as NumPy
// arrays, one step and a whole record.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <initializer_list>
#include <string>

#include "array/arrays.h"
#include "math/contact/estimator.h"

namespace armlab {

// gains (n). covariance (4, n): rows C0, Cinf, shape, kind. point: (3) in tool axes, or None.
template <class Parameters>
Parameters read_arm(const Chain &chain, nb::handle gravity_, nb::handle links_, nb::handle rotor_,
    const Drive &drive, nb::handle gains_, double gain_variance, nb::handle covariance_,
    nb::handle prior_, nb::handle point_) {
  const int n = chain.n;
  const Input gravity(gravity_, "gravity", {3}), links(links_, "links", {n, 10}),
      rotor(rotor_, "rotor", {n});
  if (drive.n != n)
    raise_shape_error("Expected a drive of " + std::to_string(n) + " joints like the chain, got " +
                      std::to_string(drive.n) + ".");
  const Input gains(gains_, "gains", {n}), covariance(covariance_, "covariance", {4, n}),
      prior(prior_, "prior", {6});
  require_positive("gains", gains.data(), n);
  require_not_negative("gain_variance", &gain_variance, 1);
  require_positive("covariance", covariance.data(), 2 * n);
  require_not_negative("covariance shape and kind", covariance.data() + 2 * n, 2 * n);
  require_positive("prior", prior.data(), 6);
  Parameters p(chain);
  std::copy_n(gravity.data(), 3, p.gravity.begin());
  std::copy_n(links.data(), 10 * n, p.links.begin());
  std::copy_n(rotor.data(), n, p.rotor.begin());
  std::copy_n(prior.data(), 6, p.prior.begin());
  p.drive = drive;
  std::copy_n(gains.data(), n, p.gains.begin());
  p.gain_variance = gain_variance;
  const double *c = covariance.data();
  for (int i = 0; i < n; ++i) p.covariance[i] = {c[i], c[n + i], c[2 * n + i], c[3 * n + i]};
  p.at_point = !point_.is_none();
  if (p.at_point) {
    const Input point(point_, "point", {3});
    if (!finite(point.data(), 3))
      raise_shape_error("Expected a finite point, got another. Correct it.");
    std::copy_n(point.data(), 3, p.point.begin());
  }
  return p;
}

// One estimate, or N of them, as fresh arrays: F, P, observability, torque error, its variance,
// flags, active joints, interval; the last is None where the method has none.
class Estimates {
 public:
  Estimates(int n, bool has_interval, npy_intp N, bool stacked) : n_(n), interval_(nullptr) {
    const auto shaped = [&](std::initializer_list<npy_intp> tail, int type) {
      npy_intp shape[3] = {N};
      npy_intp *end = std::copy(tail.begin(), tail.end(), stacked ? shape + 1 : shape);
      nb::object array = nb::steal(PyArray_SimpleNew(static_cast<int>(end - shape), shape, type));
      if (!array) throw nb::python_error();
      return array;
    };
    const auto data = [](const nb::object &array) {
      return PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr()));
    };
    arrays_ = {shaped({6}, NPY_DOUBLE), shaped({6, 6}, NPY_DOUBLE), shaped({6}, NPY_DOUBLE),
        shaped({n_}, NPY_DOUBLE), shaped({n_}, NPY_DOUBLE), shaped({n_}, NPY_BOOL), nb::none(),
        nb::none()};
    for (int k = 0; k < 5; ++k) values_[k] = static_cast<double *>(data(arrays_[k]));
    active_ = static_cast<npy_bool *>(data(arrays_[5]));
    if (has_interval) {
      arrays_[6] = shaped({6, 2}, NPY_DOUBLE);
      interval_ = static_cast<double *>(data(arrays_[6]));
    }
    flags_ = &flag_;
    if (stacked) {
      arrays_[7] = shaped({}, NPY_INT64);
      flags_ = static_cast<std::int64_t *>(data(arrays_[7]));
    }
  }

  void put(npy_intp row, const WrenchEstimate &e) {
    const double *from[5] = {e.F, e.P, e.observability, e.error, e.variance};
    const int width[5] = {6, 36, 6, n_, n_};
    for (int k = 0; k < 5; ++k) std::copy_n(from[k], width[k], values_[k] + width[k] * row);
    std::copy_n(e.active, n_, active_ + n_ * row);
    if (interval_) std::copy_n(e.interval, 12, interval_ + 12 * row);
    flags_[row] = e.flags;
  }

  nb::object tuple() {
    if (arrays_[7].is_none()) arrays_[7] = nb::int_(flag_);
    return nb::steal(PyTuple_Pack(8, arrays_[0].ptr(), arrays_[1].ptr(), arrays_[2].ptr(),
        arrays_[3].ptr(), arrays_[4].ptr(), arrays_[7].ptr(), arrays_[5].ptr(), arrays_[6].ptr()));
  }

 private:
  int n_;
  std::array<nb::object, 8> arrays_;
  std::array<double *, 5> values_;
  npy_bool *active_;
  double *interval_;
  std::int64_t *flags_, flag_ = 0;
};

template <class Estimator>
nb::object step(Estimator &self, nb::handle q_, nb::handle qd_, nb::handle tau_, double dt) {
  const int n = self.n();
  const Input q(q_, "q", {n}), qd(qd_, "qd", {n}), tau(tau_, "tau", {n});
  WrenchEstimate estimate;
  self.step(q.data(), qd.data(), tau.data(), dt, estimate);
  Estimates out(n, self.has_interval(), 1, false);
  out.put(0, estimate);
  return out.tuple();
}

template <class Estimator>
nb::object run(Estimator &self, nb::handle q_, nb::handle qd_, nb::handle tau_, nb::handle dt_) {
  const int n = self.n();
  const Input dt(dt_, "dt");
  const npy_intp N = dt.size();
  dt.require_exactly({N});
  const Input q(q_, "q", {N, n}), qd(qd_, "qd", {N, n}), tau(tau_, "tau", {N, n});
  Estimates out(n, self.has_interval(), N, true);
  {
    nb::gil_scoped_release released;
    WrenchEstimate estimate;
    for (npy_intp k = 0; k < N; ++k) {
      self.step(q.data() + n * k, qd.data() + n * k, tau.data() + n * k, dt.data()[k], estimate);
      out.put(k, estimate);
    }
  }
  return out.tuple();
}

}  // namespace armlab
