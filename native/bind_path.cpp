// Function follow_path: arguments are checked here, the mathematics is in path.h.
#include <cmath>
#include <limits>
#include <optional>
#include <type_traits>

#include "goals.h"
#include "path.h"

namespace armlab::python {
namespace {

constexpr npy_intp rows_between_signals = 4096;  // Ctrl-C ends a long path

// A vector (n) of the call, or where `rows` > 0 maybe (rows, n): its numbers, or null for None.
struct Wish {
  Wish(nb::handle value, const char *name, int n, bool finite, double least, npy_intp rows = 0) {
    if (value.is_none()) return;
    array.emplace(value, name);
    if (rows && array->ndim() == 2)
      array->require_exactly({rows, n});
    else
      array->require_exactly({n});
    for (npy_intp i = 0; i < array->size(); ++i) {
      const double number = array->data()[i];
      if (std::isnan(number) || (finite && std::isinf(number)))
        raise_shape_error(std::string("Expected ") + (finite ? "finite numbers" : "numbers") + " in " + name +
                          ", got others.");
      if (number < least) raise_shape_error(std::string("Expected no negative number in ") + name + ", got one.");
    }
  }
  const double *data() const { return array ? array->data() : nullptr; }

  std::optional<Input> array;
};

struct Results {
  double *q, *errors;
  std::int64_t *counts;
};

template <int M>
void follow(const InverseSolver &self, const Goals &goals, const Direction &axis, const PathSettings &settings,
            const double *q0, const Results &results) {
  const int n = self.chain().n;
  const auto goal = [&](npy_intp k) { return Goal(static_cast<Task>(M), goals.T.data() + 16 * k, axis.data()); };
  PathFollower<M> follower(self, settings);
  for (npy_intp begin = 0; begin < goals.count; begin += rows_between_signals) {
    {
      nb::gil_scoped_release released;
      for (npy_intp k = begin; k < std::min(goals.count, begin + rows_between_signals); ++k) {
        const PathRow row = k == 0 ? follower.first(goal(0), q0) : follower.next(goal(k));
        std::copy_n(follower.q(), n, results.q + n * k);
        results.errors[2 * k] = row.outcome.position_error;
        results.errors[2 * k + 1] = row.outcome.rotation_error;
        results.counts[3 * k] = row.outcome.steps;
        results.counts[3 * k + 1] = static_cast<std::int64_t>(row.outcome.status);
        results.counts[3 * k + 2] = row.other_branch;
      }
    }
    if (PyErr_CheckSignals() != 0) throw nb::python_error();
  }
}

nb::object follow_path(const InverseSolver &self, nb::handle T, nb::handle q0_, int task_, nb::handle axis_,
                       nb::handle change_, nb::handle posture_, nb::handle weights_, int steps, int starts,
                       double position_tolerance, double rotation_tolerance, double damping) {
  const Goals goals(T);
  if (goals.axes != 1)
    raise_shape_error("Expected T_base_tool of shape (N, 4, 4), one pose after the other, got " + goals.T.shape_text() +
                      ".");
  const int n = self.chain().n;
  const Task task = task_of(task_);
  const Direction axis(axis_);
  const Search search = search_of(steps, starts, position_tolerance, rotation_tolerance, damping);
  constexpr double any = -std::numeric_limits<double>::infinity();
  const Wish q0(q0_, "q0", n, true, any), change(change_, "change", n, false, 0.0);
  const Wish posture(posture_, "posture", n, true, any, goals.count), weights(weights_, "weights", n, true, 0.0);
  if (!posture.data() != !weights.data())
    raise_shape_error("Expected posture and weights together, got one of them alone.");
  const PathSettings settings{search, change.data(), posture.data(), weights.data(),
                              !posture.data() || posture.array->ndim() == 1};

  Results results;
  const nb::object q = goals.fresh(NPY_DOUBLE, {n}, &results.q);
  const nb::object errors = goals.fresh(NPY_DOUBLE, {2}, &results.errors);
  const nb::object counts = goals.fresh(NPY_INT64, {3}, &results.counts);
  const auto run = [&](auto rows) { follow<rows>(self, goals, axis, settings, q0.data(), results); };
  switch (task) {
    case Task::position: run(std::integral_constant<int, 3>()); break;
    case Task::position_axis: run(std::integral_constant<int, 5>()); break;
    case Task::axis: run(std::integral_constant<int, 2>()); break;
    default: run(std::integral_constant<int, 6>());
  }
  return nb::make_tuple(q, errors, counts);
}

}  // namespace
}  // namespace armlab::python

void bind_path(nb::module_ &m) {
  using nb::arg;
  m.def("follow_path", &armlab::python::follow_path, arg("solver"), arg("T_base_tool"), arg("q0") = nb::none(),
        arg("task") = 6, arg("axis") = nb::make_tuple(0.0, 0.0, 1.0), arg("change") = nb::none(),
        arg("posture") = nb::none(), arg("weights") = nb::none(), arg("steps") = 100, arg("starts") = 100,
        arg("position_tolerance") = 1e-9, arg("rotation_tolerance") = 1e-9, arg("damping") = 0.1,
        "Return postures, errors and counts along a path; see armlab/kernels/_reference/path.py.");
}
