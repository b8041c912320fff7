// Python class InverseSolver: arguments are checked here, the mathematics is in inverse.cpp.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "math/inverse/goals.h"

namespace armlab::python {
namespace {

void construct(InverseSolver *self, const Chain &chain, nb::handle low_, nb::handle high_,
    nb::handle home_, std::uint64_t seed) {
  const Input low(low_, "q_min"), high(high_, "q_max"), home(home_, "q_home");
  for (const Input *vector : {&low, &high, &home}) vector->require_exactly({chain.n});
  for (int i = 0; i < chain.n; ++i)
    if (!(low.data()[i] <= home.data()[i] && home.data()[i] <= high.data()[i] &&
            std::isfinite(home.data()[i])))
      raise_shape_error(
          "Expected q_min <= q_home <= q_max and a finite q_home, got others at joint " +
          std::to_string(i + 1) + ".");
  new (self) InverseSolver(chain, low.data(), high.data(), home.data(), seed);
}

// Runs solve(goal, search, k, q) -> Outcome over the goals.
template <class Solve>
nb::object run(int n, const Request &request, Solve solve) {
  const Goals &goals = request.goals;
  double *q, *errors, *path = nullptr;
  std::int64_t *counts;
  const npy_intp length = 2 * (npy_intp{request.search.steps} + 1);
  const nb::object q_array = goals.fresh(NPY_DOUBLE, {n}, &q),
                   error_array = goals.fresh(NPY_DOUBLE, {3}, &errors);
  const nb::object count_array = goals.fresh(NPY_INT64, {3}, &counts);
  nb::object history_array = nb::none();
  if (request.history) history_array = goals.fresh(NPY_DOUBLE, {length / 2, 2}, &path);

  const auto work = [&](npy_intp begin, npy_intp end) {
    for (npy_intp k = begin; k < end; ++k) {
      Search search = request.search_of(k);
      if (path) search.history = path + length * k;
      const Outcome outcome = solve(request.goal(k), search, k, q + n * k);
      errors[3 * k] = outcome.position_error;
      errors[3 * k + 1] = outcome.rotation_error;
      errors[3 * k + 2] = outcome.slope;
      counts[3 * k] = outcome.steps;
      counts[3 * k + 1] = outcome.starts;
      counts[3 * k + 2] = static_cast<std::int64_t>(outcome.status);
    }
  };
  if (goals.count < 8) {
    work(0, goals.count);
  } else {
    nb::gil_scoped_release released;
    run_parallel(goals.count, 16, request.threads, work);
  }
  return nb::make_tuple(q_array, error_array, count_array, history_array);
}

nb::object solve(const InverseSolver &self, nb::handle T, nb::handle q0, int task, nb::handle axis,
    int steps, int starts, double position_tolerance, double rotation_tolerance, double damping,
    int objective, nb::handle reference, nb::handle scale, bool history, nb::handle threads) {
  const int n = self.chain().n;
  const Search search =
      search_of(steps, starts, position_tolerance, rotation_tolerance, damping, objective);
  const Request request(T, n, task, axis, search, reference, scale, history, threads);
  if (q0.is_none())
    return run(n, request, [&](const Goal &goal, const Search &own, npy_intp, double *q) {
      return self.solve(goal, own, nullptr, q);
    });
  const Vectors from(q0, "q0", request.goals, n);
  return run(n, request, [&](const Goal &goal, const Search &own, npy_intp k, double *q) {
    return self.solve(goal, own, from.of(k), q);
  });
}

nb::object follow(const InverseSolver &self, nb::handle T, nb::handle q0, double change, int task,
    nb::handle axis, int steps, double position_tolerance, double rotation_tolerance,
    double damping, int objective, nb::handle reference, nb::handle scale, bool history,
    nb::handle threads) {
  const int n = self.chain().n;
  if (!(change >= 0.0))
    raise_shape_error("Expected change >= 0, got " + std::to_string(change) + ".");
  const Search search =
      search_of(steps, 1, position_tolerance, rotation_tolerance, damping, objective);
  const Request request(T, n, task, axis, search, reference, scale, history, threads);
  const Vectors from(q0, "q0", request.goals, n);
  return run(n, request, [&](const Goal &goal, const Search &own, npy_intp k, double *q) {
    return self.follow(goal, own, from.of(k), self.around(from.of(k), change), q);
  });
}

}  // namespace

void bind_inverse_solver(nb::module_ &m) {
  using nb::arg;
  nb::class_<InverseSolver>(
      m, "InverseSolver", "Inverse kinematics, immutable; _native.pyi documents it.")
      .def("__init__", &construct, arg("chain"), array("q_min"), array("q_max"), array("q_home"),
          arg("seed") = 0)
      .def("solve", &solve, array("T_base_tool"), arg("q0") = nb::none(), arg("task") = 6,
          array("axis") = nb::make_tuple(0.0, 0.0, 1.0), arg("steps") = 100, arg("starts") = 100,
          arg("position_tolerance") = 1e-9, arg("rotation_tolerance") = 1e-9, arg("damping") = 0.1,
          arg("objective") = 0, arg("reference") = nb::none(), arg("scale") = nb::none(),
          arg("history") = false, arg("threads").none() = 1)
      .def("follow", &follow, array("T_base_tool"), array("q0"),
          arg("change") = std::numeric_limits<double>::infinity(), arg("task") = 6,
          array("axis") = nb::make_tuple(0.0, 0.0, 1.0), arg("steps") = 100,
          arg("position_tolerance") = 1e-9, arg("rotation_tolerance") = 1e-9, arg("damping") = 0.1,
          arg("objective") = 0, arg("reference") = nb::none(), arg("scale") = nb::none(),
          arg("history") = false, arg("threads").none() = 1);
}

}  // namespace armlab::python

void bind_inverse(nb::module_ &m) { armlab::python::bind_inverse_solver(m); }
