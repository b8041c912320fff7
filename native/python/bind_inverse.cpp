// Python class InverseSolver and function follow_path; mathematics in inverse.cpp and path.h.
#include "array/lie_arguments.h"
#include "math/inverse/path.h"

namespace armlab::python {
namespace {

bool is_pose(const double *m) {
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
            "Expected finite poses with a rotation orthonormal to 1e-5 and last row 0 0 0 1, got " +
            place("T_base_tool", k, T.shape(), axes) +
            " that is not. Project it if it is nearly one (lie.se3.project).");
    restore_digits(T);
  }

  // Returns a fresh array of shape batch + tail.
  template <class Number>
  nb::object fresh(int type, std::initializer_list<npy_intp> tail, Number **data) const {
    npy_intp shape[NPY_MAXDIMS + 2];
    std::copy(tail.begin(), tail.end(), std::copy(T.shape(), T.shape() + axes, shape));
    nb::object array = fresh_of_type(type, axes + static_cast<int>(tail.size()), shape);
    *data = numbers<Number>(array);
    return array;
  }

  Input T;
  const int axes;
  npy_intp count;
};

// Finite joint vectors: one for all goals, or one per goal.
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
        raise_shape_error("Expected finite joint positions, got NaN or Inf in " +
                          place(name, k / n, q.shape(), q.ndim() - 1) + ".");
    stride = one ? 0 : n;
  }
  const double *of(npy_intp k) const { return q.data() + k * stride; }

  const Input q;
  npy_intp stride;
};

Task task_of(int rows) {
  if (rows != 6 && rows != 3 && rows != 5 && rows != 2)
    raise_shape_error("Expected a task of 6, 5, 3 or 2 rows, got " + std::to_string(rows) + ".");
  return static_cast<Task>(rows);
}

Search search_of(
    int steps, int starts, double position, double rotation, double damping, int objective) {
  if (objective < 0 || objective > 3)
    raise_shape_error("Expected an objective from 0 to 3, got " + std::to_string(objective) + ".");
  if (steps < 0 || starts < 1 || !(position >= 0.0) || !(rotation >= 0.0) || !(damping > 0.0))
    raise_shape_error(
        "Expected steps >= 0, starts >= 1, tolerances >= 0 and damping > 0, got other values.");
  return {steps, starts, position, rotation, damping,
      {static_cast<Objective::Kind>(objective), nullptr, nullptr}};
}

// The arguments shared by `solve` and `follow`, except the goals.
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
          "Expected axis to be a direction in tool axes, got a vector that is not finite or has no "
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
    const double values[max_joints] = {};
    return fresh_array({n}, values);
  }
};

void construct(InverseSolver *self, const Chain &chain, nb::handle low_, nb::handle high_,
    nb::handle home_, std::uint64_t seed) {
  const Input low(low_, "q_min"), high(high_, "q_max"), home(home_, "q_home");
  for (const Input *vector : {&low, &high, &home}) vector->require_exactly({chain.n});
  for (int i = 0; i < chain.n; ++i)
    if (!(low.data()[i] <= home.data()[i] && home.data()[i] <= high.data()[i] &&
            std::isfinite(home.data()[i])))
      raise_shape_error(
          "Expected q_min <= q_home <= q_max and a finite q_home, got other values at joint " +
          std::to_string(i + 1) + ".");
  new (self) InverseSolver(chain, low.data(), high.data(), home.data(), seed);
}

// New arrays for the results of a call: q (n), errors (3) and counts (3) per goal.
struct Results {
  Results(const Goals &goals, int n_)
      : n(n_),
        q_array(goals.fresh(NPY_DOUBLE, {n}, &q)),
        error_array(goals.fresh(NPY_DOUBLE, {3}, &errors)),
        count_array(goals.fresh(NPY_INT64, {3}, &counts)) {}

  void put(npy_intp k, const Outcome &outcome, int second, int third) const {
    const double found[3] = {outcome.position_error, outcome.rotation_error, outcome.slope};
    const std::int64_t counted[3] = {outcome.steps, second, third};
    std::copy_n(found, 3, errors + 3 * k);
    std::copy_n(counted, 3, counts + 3 * k);
  }

  int n;
  double *q, *errors;
  std::int64_t *counts;
  nb::object q_array, error_array, count_array;
};

// Runs solve(goal, search, k, q) -> Outcome for each goal.
template <class Solve>
nb::object run(int n, const Request &request, Solve solve) {
  const Goals &goals = request.goals;
  const Results results(goals, n);
  double *path = nullptr;
  const npy_intp length = 2 * (npy_intp{request.search.steps} + 1);
  nb::object history_array = nb::none();
  if (request.history) history_array = goals.fresh(NPY_DOUBLE, {length / 2, 2}, &path);

  const auto work = [&](npy_intp begin, npy_intp end) {
    for (npy_intp k = begin; k < end; ++k) {
      Search search = request.search_of(k);
      if (path) search.history = path + length * k;
      const Outcome outcome = solve(request.goal(k), search, k, results.q + n * k);
      results.put(k, outcome, outcome.starts, static_cast<int>(outcome.status));
    }
  };
  if (goals.count < 8) {
    work(0, goals.count);
  } else {
    nb::gil_scoped_release released;
    run_parallel(goals.count, 16, request.threads, work);
  }
  return nb::make_tuple(results.q_array, results.error_array, results.count_array, history_array);
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

constexpr npy_intp rows_between_signals = 4096;  // so Ctrl-C can stop a long path

template <int M>
void follow_rows(const InverseSolver &self, const Request &request, const double *change,
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
        results.put(k, row.outcome, static_cast<int>(row.outcome.status), row.other_branch);
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
    raise_shape_error("Expected T_base_tool of shape (N, 4, 4), poses in path order, got " +
                      goals.T.shape_text() + ".");
  const Input q0(q0_.is_none() ? request.zeros(n) : nb::borrow(q0_), "q0");
  const Input change(change_.is_none() ? request.zeros(n) : nb::borrow(change_), "change");
  q0.require_exactly({n});
  change.require_exactly({n});
  for (int i = 0; i < n; ++i) {
    if (!std::isfinite(q0.data()[i]))
      raise_shape_error("Expected finite joint positions, got NaN or Inf in q0.");
    if (!(change.data()[i] >= 0.0)) raise_shape_error("Expected change >= 0, got another value.");
  }
  const Results results(goals, n);
  with_rows(request.task, [&](auto rows) {
    follow_rows<rows>(self, request, change_.is_none() ? nullptr : change.data(),
        q0_.is_none() ? nullptr : q0.data(), results);
  });
  return nb::make_tuple(results.q_array, results.error_array, results.count_array);
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_inverse(nb::module_ &m) {
  const auto none = [](const char *name) { return arg(name) = nb::none(); };
  const auto axis = [] { return array("axis") = nb::make_tuple(0.0, 0.0, 1.0); };
  const auto near = [](const char *name) { return arg(name) = 1e-9; };
  nb::class_<InverseSolver>(
      m, "InverseSolver", "Inverse kinematics, immutable; _native.pyi documents it.")
      .def("__init__", &construct, arg("chain"), array("q_min"), array("q_max"), array("q_home"),
          arg("seed") = 0)
      .def("solve", &solve, array("T_base_tool"), none("q0"), arg("task") = 6, axis(),
          arg("steps") = 100, arg("starts") = 100, near("position_tolerance"),
          near("rotation_tolerance"), arg("damping") = 0.1, arg("objective") = 0, none("reference"),
          none("scale"), arg("history") = false, arg("threads").none() = 1)
      .def("follow", &follow, array("T_base_tool"), array("q0"),
          arg("change") = std::numeric_limits<double>::infinity(), arg("task") = 6, axis(),
          arg("steps") = 100, near("position_tolerance"), near("rotation_tolerance"),
          arg("damping") = 0.1, arg("objective") = 0, none("reference"), none("scale"),
          arg("history") = false, arg("threads").none() = 1);
  m.def("follow_path", &follow_path, arg("solver"), array("T_base_tool"), none("q0"),
      none("change"), arg("task") = 6, axis(), arg("steps") = 100, arg("starts") = 100,
      near("position_tolerance"), near("rotation_tolerance"), arg("damping") = 0.1,
      arg("objective") = 0, none("reference"), none("scale"));
}
