// Arguments of the inverse kinematics that several functions take.
#pragma once

#include <algorithm>
#include <cmath>

#include "array/arrays.h"
#include "math/inverse/inverse.h"
#include "array/lie_arguments.h"

namespace armlab::python {

inline bool is_pose(const double *m) {
  for (int k = 0; k < 16; ++k)
    if (!std::isfinite(m[k])) return false;
  if (m[12] != 0.0 || m[13] != 0.0 || m[14] != 0.0 || m[15] != 1.0) return false;
  const Rotation<double> R = rotation_at(m, 4);
  return departure(R) <= rotation_tolerance && dot(cross(R.x, R.y), R.z) > 0.0;
}

// The goals of a call, one per sample.
struct Goals {
  explicit Goals(nb::handle value) : T(value, "T_base_tool"), axes(T.ndim() - 2) {
    if (axes < 0 || T.shape()[axes] != 4 || T.shape()[axes + 1] != 4)
      raise_shape_error("Expected T_base_tool of shape (..., 4, 4), got " + T.shape_text() + ".");
    count = T.size() / 16;
    for (npy_intp k = 0; k < count; ++k)
      if (!is_pose(T.data() + 16 * k))
        raise_shape_error(
            "Expected finite poses with a rotation orthonormal to 1e-6 and last row 0 0 0 1, got " +
            place("T_base_tool", k, T.shape(), axes) +
            " that is not. Project it if it is nearly one (lie.se3.project).");
  }

  // A fresh array of shape batch + tail.
  template <class Number>
  nb::object fresh(int type, std::initializer_list<npy_intp> tail, Number **data) const {
    npy_intp shape[NPY_MAXDIMS + 2];
    std::copy(tail.begin(), tail.end(), std::copy(T.shape(), T.shape() + axes, shape));
    nb::object array =
        nb::steal(PyArray_SimpleNew(axes + static_cast<int>(tail.size()), shape, type));
    if (!array.is_valid()) throw nb::python_error();
    *data = static_cast<Number *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr())));
    return array;
  }

  const Input T;
  const int axes;
  npy_intp count;
};

// Joint vectors: one for all goals, or one per goal, finite.
struct Vectors {
  Vectors(nb::handle value, const char *name, const Goals &goals, int n) : q(value, name) {
    const bool one = q.ndim() == 1 && q.shape()[0] == n;
    const bool each = q.ndim() == goals.axes + 1 &&
                      std::equal(q.shape(), q.shape() + goals.axes, goals.T.shape()) &&
                      q.shape()[goals.axes] == n;
    if (!one && !each)
      raise_shape_error(std::string("Expected ") + name + " of shape (" + std::to_string(n) +
                        ",) or one posture per goal of T_base_tool " + goals.T.shape_text() +
                        ", got " + q.shape_text() + ".");
    for (npy_intp k = 0; k < q.size(); ++k)
      if (!std::isfinite(q.data()[k]))
        raise_shape_error("Expected finite joint positions, got others in " +
                          place(name, k / n, q.shape(), q.ndim() - 1) + ".");
    stride = one ? 0 : n;
  }
  const double *of(npy_intp k) const { return q.data() + k * stride; }

  const Input q;
  npy_intp stride;
};

inline Task task_of(int rows) {
  if (rows != 6 && rows != 3 && rows != 5 && rows != 2)
    raise_shape_error("Expected a task of 6, 5, 3 or 2 rows, got " + std::to_string(rows) + ".");
  return static_cast<Task>(rows);
}

inline Search search_of(
    int steps, int starts, double position, double rotation, double damping, int objective) {
  if (objective < 0 || objective > 3)
    raise_shape_error("Expected an objective from 0 to 3, got " + std::to_string(objective) + ".");
  if (steps < 0 || starts < 1 || !(position >= 0.0) || !(rotation >= 0.0) || !(damping > 0.0))
    raise_shape_error(
        "Expected steps >= 0, starts >= 1, tolerances >= 0 and damping > 0, got others.");
  return {steps, starts, position, rotation, damping,
      {static_cast<Objective::Kind>(objective), nullptr, nullptr}};
}

// What a call asks for besides the goals: the arguments that `solve` and `follow` have in common.
struct Request {
  Request(nb::handle T, int n, int task_, nb::handle axis_, const Search &search_,
      nb::handle reference_, nb::handle scale_, bool history_, nb::handle threads_)
      : goals(T),
        task(task_of(task_)),
        axis(axis_, "axis", {3}),
        search(search_),
        reference(reference_.is_none() ? zeros(n) : nb::borrow(reference_), "posture", goals, n),
        scale(scale_.is_none() ? zeros(n) : nb::borrow(scale_), "scale", {n}),
        history(history_),
        threads(thread_count(threads_)) {
    const double *a = axis.data(),
                 longest = std::max({std::fabs(a[0]), std::fabs(a[1]), std::fabs(a[2])});
    if (!(std::isfinite(a[0] + a[1] + a[2]) && longest > 1e-9))
      raise_shape_error(
          "Expected axis to be a direction in tool axes, got one that is not finite or has no "
          "length.");
  }

  const Goals goals;
  const Task task;
  const Input axis;
  const Search search;
  const Vectors reference;
  const Input scale;
  const bool history;
  const int threads;

  Goal goal(npy_intp k) const { return Goal(task, goals.T.data() + 16 * k, axis.data()); }
  Search search_of(npy_intp k) const {
    Search own = search;
    own.objective.reference = reference.of(k);
    own.objective.scale = scale.data();
    return own;
  }
  static nb::object zeros(int n) {
    const npy_intp shape[1] = {n};
    const double values[max_joints] = {};
    return fresh_array(1, shape, values);
  }
};

}  // namespace armlab::python
