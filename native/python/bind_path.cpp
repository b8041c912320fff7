// Function follow_path: arguments are checked here, the mathematics is in path.h.
#include <limits>
#include <type_traits>

#include "math/inverse/goals.h"
#include "math/inverse/path.h"

namespace armlab::python {
namespace {

constexpr npy_intp rows_between_signals = 4096;  // Ctrl-C ends a long path

struct Results {
  double *q, *errors;
  std::int64_t *counts;
};

template <int M>
void follow(const InverseSolver &self, const Request &request, const double *change,
    const double *q0, const Results &results) {
  const int n = self.chain().n;
  const npy_intp count = request.goals.count;
  PathFollower<M> follower(self, change);
  for (npy_intp begin = 0; begin < count; begin += rows_between_signals) {
    {
      nb::gil_scoped_release released;
      for (npy_intp k = begin; k < std::min(count, begin + rows_between_signals); ++k) {
        const Goal goal = request.goal(k);
        const Search search = request.search_of(k);
        const PathRow row = k == 0 ? follower.first(goal, search, q0) : follower.next(goal, search);
        std::copy_n(follower.q(), n, results.q + n * k);
        results.errors[3 * k] = row.outcome.position_error;
        results.errors[3 * k + 1] = row.outcome.rotation_error;
        results.errors[3 * k + 2] = row.outcome.slope;
        results.counts[3 * k] = row.outcome.steps;
        results.counts[3 * k + 1] = static_cast<std::int64_t>(row.outcome.status);
        results.counts[3 * k + 2] = row.other_branch;
      }
    }
    if (PyErr_CheckSignals() != 0) throw nb::python_error();
  }
}

nb::object follow_path(const InverseSolver &self, nb::handle T, nb::handle q0_, nb::handle change_,
    int task, nb::handle axis, int steps, int starts, double position_tolerance,
    double rotation_tolerance, double damping, int objective, nb::handle reference,
    nb::handle scale) {
  const int n = self.chain().n;
  const Search search =
      search_of(steps, starts, position_tolerance, rotation_tolerance, damping, objective);
  const Request request(T, n, task, axis, search, reference, scale, false, nb::int_(1));
  const Goals &goals = request.goals;
  if (goals.axes != 1)
    raise_shape_error("Expected T_base_tool of shape (N, 4, 4), one pose after the other, got " +
                      goals.T.shape_text() + ".");
  const Input q0(q0_.is_none() ? request.zeros(n) : nb::borrow(q0_), "q0");
  const Input change(change_.is_none() ? request.zeros(n) : nb::borrow(change_), "change");
  q0.require_exactly({n});
  change.require_exactly({n});
  for (int i = 0; i < n; ++i) {
    if (!std::isfinite(q0.data()[i]))
      raise_shape_error("Expected finite joint positions, got others in q0.");
    if (!(change.data()[i] >= 0.0)) raise_shape_error("Expected change >= 0, got others.");
  }
  Results results;
  const nb::object q = goals.fresh(NPY_DOUBLE, {n}, &results.q);
  const nb::object errors = goals.fresh(NPY_DOUBLE, {3}, &results.errors);
  const nb::object counts = goals.fresh(NPY_INT64, {3}, &results.counts);
  const auto run = [&](auto rows) {
    follow<rows>(self, request, change_.is_none() ? nullptr : change.data(),
        q0_.is_none() ? nullptr : q0.data(), results);
  };
  switch (request.task) {
    case Task::position:
      run(std::integral_constant<int, 3>());
      break;
    case Task::position_axis:
      run(std::integral_constant<int, 5>());
      break;
    case Task::axis:
      run(std::integral_constant<int, 2>());
      break;
    default:
      run(std::integral_constant<int, 6>());
  }
  return nb::make_tuple(q, errors, counts);
}

}  // namespace
}  // namespace armlab::python

void bind_path(nb::module_ &m) {
  using armlab::array;
  using nb::arg;
  m.def("follow_path", &armlab::python::follow_path, arg("solver"), array("T_base_tool"),
      arg("q0") = nb::none(), arg("change") = nb::none(), arg("task") = 6,
      array("axis") = nb::make_tuple(0.0, 0.0, 1.0), arg("steps") = 100, arg("starts") = 100,
      arg("position_tolerance") = 1e-9, arg("rotation_tolerance") = 1e-9, arg("damping") = 0.1,
      arg("objective") = 0, arg("reference") = nb::none(), arg("scale") = nb::none(),
      "Return postures, errors and counts along a path.");
}
