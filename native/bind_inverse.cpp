// Python class InverseSolver: arguments are checked here, the mathematics is in inverse.cpp.
#include <limits>

#include "goals.h"

namespace armlab::python {
namespace {

void construct(InverseSolver *self, const Chain &chain, nb::handle low_, nb::handle high_, nb::handle home_,
               std::uint64_t seed) {
  const Input low(low_, "q_min"), high(high_, "q_max"), home(home_, "q_home");
  for (const Input *vector : {&low, &high, &home}) vector->require_exactly({chain.n});
  for (int i = 0; i < chain.n; ++i)
    if (!(low.data()[i] <= home.data()[i] && home.data()[i] <= high.data()[i] && std::isfinite(home.data()[i])))
      raise_shape_error("Expected q_min <= q_home <= q_max and a finite q_home, got others at joint " +
                        std::to_string(i + 1) + ".");
  new (self) InverseSolver(chain, low.data(), high.data(), home.data(), seed);
}

// Starts: one posture for all goals, or one per goal, finite.
struct Starts {
  Starts(nb::handle value, const Goals &goals, int n) : q(value, "q0") {
    const bool one = q.ndim() == 1 && q.shape()[0] == n;
    const bool each = q.ndim() == goals.axes + 1 && std::equal(q.shape(), q.shape() + goals.axes, goals.T.shape()) &&
                      q.shape()[goals.axes] == n;
    if (!one && !each)
      raise_shape_error("Expected q0 of shape (" + std::to_string(n) + ",) or one posture per goal of T_base_tool " +
                        goals.T.shape_text() + ", got " + q.shape_text() + ".");
    for (npy_intp k = 0; k < q.size(); ++k)
      if (!std::isfinite(q.data()[k]))
        raise_shape_error("Expected finite joint positions, got others in " +
                          place("q0", k / n, q.shape(), q.ndim() - 1) + ".");
    stride = one ? 0 : n;
  }
  const double *of(npy_intp k) const { return q.data() + k * stride; }

  const Input q;
  npy_intp stride;
};

// Runs solve(goal, search, k, q) -> Outcome over the goals.
template <class Solve>
nb::object run(const InverseSolver &self, const Goals &goals, Task task, nb::handle axis_, const Search &search,
               bool history, int threads, Solve solve) {
  const Direction axis(axis_);
  double *q, *errors, *path = nullptr;
  std::int64_t *counts;
  const int n = self.chain().n, length = search.steps + 1;
  const nb::object q_array = goals.fresh(NPY_DOUBLE, {n}, &q), error_array = goals.fresh(NPY_DOUBLE, {2}, &errors);
  const nb::object count_array = goals.fresh(NPY_INT64, {3}, &counts);
  nb::object history_array = nb::none();
  if (history) history_array = goals.fresh(NPY_DOUBLE, {length, 2}, &path);

  const auto work = [&](npy_intp begin, npy_intp end) {
    for (npy_intp k = begin; k < end; ++k) {
      Search own = search;
      if (path) own.history = path + 2 * length * k;
      const Outcome outcome = solve(Goal(task, goals.T.data() + 16 * k, axis.data()), own, k, q + n * k);
      errors[2 * k] = outcome.position_error;
      errors[2 * k + 1] = outcome.rotation_error;
      counts[3 * k] = outcome.steps;
      counts[3 * k + 1] = outcome.starts;
      counts[3 * k + 2] = static_cast<std::int64_t>(outcome.status);
    }
  };
  if (goals.count < 8) {
    work(0, goals.count);
  } else {
    nb::gil_scoped_release released;
    run_parallel(goals.count, 16, threads, work);
  }
  return nb::make_tuple(q_array, error_array, count_array, history_array);
}

nb::object solve(const InverseSolver &self, nb::handle T, nb::handle q0, int task, nb::handle axis, int steps,
                 int starts, double position_tolerance, double rotation_tolerance, double damping, bool history,
                 nb::handle threads) {
  const Goals goals(T);
  const Search search = search_of(steps, starts, position_tolerance, rotation_tolerance, damping);
  const int count = thread_count(threads);
  if (q0.is_none())
    return run(self, goals, task_of(task), axis, search, history, count,
               [&](const Goal &goal, const Search &own, npy_intp, double *q) { return self.solve(goal, own, nullptr, q); });
  const Starts from(q0, goals, self.chain().n);
  return run(self, goals, task_of(task), axis, search, history, count,
             [&](const Goal &goal, const Search &own, npy_intp k, double *q) { return self.solve(goal, own, from.of(k), q); });
}

nb::object follow(const InverseSolver &self, nb::handle T, nb::handle q0, double change, int task, nb::handle axis,
                  int steps, double position_tolerance, double rotation_tolerance, double damping, bool history,
                  nb::handle threads) {
  const Goals goals(T);
  const Starts from(q0, goals, self.chain().n);
  if (!(change >= 0.0)) raise_shape_error("Expected change >= 0, got " + std::to_string(change) + ".");
  const Search search = search_of(steps, 1, position_tolerance, rotation_tolerance, damping);
  return run(self, goals, task_of(task), axis, search, history, thread_count(threads),
             [&](const Goal &goal, const Search &own, npy_intp k, double *q) {
               return self.follow(goal, own, from.of(k), self.around(from.of(k), change), q);
             });
}

}  // namespace

void bind_inverse_solver(nb::module_ &m) {
  using nb::arg;
  nb::class_<InverseSolver>(m, "InverseSolver",
                            "Inverse kinematics, immutable; armlab.kernels._reference.InverseSolver documents it.")
      .def("__init__", &construct, arg("chain"), arg("q_min"), arg("q_max"), arg("q_home"), arg("seed") = 0)
      .def("solve", &solve, arg("T_base_tool"), arg("q0") = nb::none(), arg("task") = 6,
           arg("axis") = nb::make_tuple(0.0, 0.0, 1.0), arg("steps") = 100, arg("starts") = 100,
           arg("position_tolerance") = 1e-9, arg("rotation_tolerance") = 1e-9, arg("damping") = 0.1,
           arg("history") = false, arg("threads") = 1)
      .def("follow", &follow, arg("T_base_tool"), arg("q0"),
           arg("change") = std::numeric_limits<double>::infinity(), arg("task") = 6,
           arg("axis") = nb::make_tuple(0.0, 0.0, 1.0), arg("steps") = 100, arg("position_tolerance") = 1e-9,
           arg("rotation_tolerance") = 1e-9, arg("damping") = 0.1, arg("history") = false, arg("threads") = 1);
}

}  // namespace armlab::python

void bind_inverse(nb::module_ &m) { armlab::python::bind_inverse_solver(m); }
