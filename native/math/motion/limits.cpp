// Limits applied to one reference before it is sent to a robot. Specification:
// tests/oracles/limits.py.
#include "array/arrays.h"

namespace armlab::python {
namespace {

constexpr std::uint8_t position_bit = 1, velocity_bit = 2, acceleration_bit = 4, braking_bit = 8;
constexpr double slack = 1e-9;  // relative tolerance, because rounding is not a clamp
constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr int max_axes = 64;

// The largest velocity v in a step T after which an arm with delay `lag` can still stop within
// `distance` at all later steps: v T + v lag + v^2 / (2 a) = distance.
double brakeable(double distance, double a, double T, double lag) {
  const double d = std::max(distance, 0.0), late = T + lag;
  if (std::isinf(d)) return infinity;
  if (std::isinf(a)) return d / late;
  const double b = a * late;
  return d > 0.0 ? 2.0 * a * d / (std::sqrt(b * b + 2.0 * a * d) + b) : 0.0;
}

struct Joint {
  double q, q_min, q_max, fastest, a;
  double low, high;  // velocities that still allow a stop before the limits
};

// Scales all velocities by one ratio if any is too large. Returns the ratio.
double scale(int n, const Joint *joints, double *wanted, std::uint8_t *bits) {
  double worst = 0.0, ratio = 1.0;
  for (int i = 0; i < n; ++i) worst = std::max(worst, std::fabs(wanted[i]) / joints[i].fastest);
  if (worst > 1.0 + slack) {
    ratio = 1.0 / worst;
    for (int i = 0; i < n; ++i) {
      if (std::fabs(wanted[i]) / joints[i].fastest > 1.0 + slack) bits[i] |= velocity_bit;
      wanted[i] *= ratio;
    }
  }
  return ratio;
}

// Limits each velocity by acceleration and braking distance.
void keep_within(
    int n, const Joint *joints, double T, const double *last, double *wanted, std::uint8_t *bits) {
  for (int i = 0; i < n; ++i) {
    const Joint &joint = joints[i];
    const double step = joint.a * T, tolerance = slack * std::min(step, joint.fastest);
    const double bounds[2][2] = {{last[i] - step, last[i] + step}, {joint.low, joint.high}};
    const std::uint8_t names[2] = {acceleration_bit, braking_bit};
    for (int b = 0; b < 2; ++b) {
      if (wanted[i] < bounds[b][0] - tolerance || wanted[i] > bounds[b][1] + tolerance) {
        bits[i] |= names[b];
        wanted[i] = wanted[i] < bounds[b][0] ? bounds[b][0] : bounds[b][1];
      }
    }
  }
}

// 0 if valid, i (from 1) if joint i is not finite, or -i if it jumps.
int refusal(int n, const Joint *joints, const double *jump, double T, const double *q_ref,
    const double *q_last, const double *qd_ref) {
  for (int i = 0; i < n; ++i) {
    for (const double *values : {q_ref, q_last, qd_ref})
      if (values && !std::isfinite(values[i])) return i + 1;
    if (q_ref && std::fabs(q_ref[i] - joints[i].q) > jump[i] + joints[i].fastest * T)
      return -(i + 1);
  }
  return 0;
}

// An optional vector argument: its numbers, or null for None.
struct Optional {
  Optional(nb::handle value, const char *name, int n)
      : input(value.is_none() ? nb::handle(empty()) : value, name) {
    if (value.is_none()) return;
    input.require_exactly({n});
    data = input.data();
  }
  static nb::object empty() {
    static const nb::object *none = new nb::object(fresh_array({0}));
    return *none;
  }
  Input input;
  const double *data = nullptr;
};

nb::object limit_reference(nb::handle sent_, nb::handle bounds_, double T, nb::handle q_ref_,
    nb::handle q_last_, nb::handle qd_ref_, double lag) {
  const Input sent(sent_, "sent"), bounds(bounds_, "bounds");
  const npy_intp count = sent.size() / 3;
  sent.require_exactly({3, count});
  bounds.require_exactly({5, count});
  if (count > max_axes || !(T > 0.0) || !(lag >= 0.0))
    raise_shape_error("Expected at most " + std::to_string(max_axes) +
                      " joints, a positive period and a non-negative lag, " + "got " +
                      std::to_string(count) + ", " + std::to_string(T) + " s and " +
                      std::to_string(lag) + " s.");
  const int n = static_cast<int>(count);
  const Optional asked(q_ref_, "q_ref", n), before(q_last_, "q_last", n),
      speed(qd_ref_, "qd_ref", n);
  const double *q_ref = asked.data, *q_last = before.data, *qd_ref = speed.data;

  Joint joints[max_axes];
  for (int i = 0; i < n; ++i) {
    const double *b = bounds.data(), q = sent.data()[i], a = b[3 * n + i];
    const double back = brakeable(q - b[i], a, T, lag), forth = brakeable(b[n + i] - q, a, T, lag);
    joints[i] = {q, b[i], b[n + i], b[2 * n + i], a, -back, forth};
  }
  const int refused = refusal(n, joints, bounds.data() + 4 * n, T, q_ref, q_last, qd_ref);
  if (refused) q_ref = q_last = qd_ref = nullptr;

  const nb::object out = fresh_array({3, n});
  npy_intp length = n;
  const nb::object bits_array = nb::steal(PyArray_ZEROS(1, &length, NPY_UINT8, 0));
  if (!bits_array.is_valid()) throw nb::python_error();
  double *next = numbers(out);
  std::uint8_t *bits = numbers<std::uint8_t>(bits_array);
  double *moved = next, *v = next + n, *f = next + 2 * n;
  double wanted[max_axes];
  bool reached[max_axes];
  for (int i = 0; i < n; ++i) {
    const Joint &joint = joints[i];
    wanted[i] = qd_ref ? qd_ref[i] : 0.0;
    if (!q_ref) continue;
    if (q_ref[i] < joint.q_min || q_ref[i] > joint.q_max) bits[i] |= position_bit;
    const double last = q_last ? q_last[i] : q_ref[i], behind = last - joint.q;
    reached[i] = std::fabs(behind) <= joint.a * T * T;
    const double catching_up = std::copysign(brakeable(std::fabs(behind), joint.a, T, 0.0), behind);
    wanted[i] = reached[i] ? (q_ref[i] - joint.q) / T : (q_ref[i] - last) / T + catching_up;
  }
  std::copy_n(wanted, n, v);
  const double ratio = scale(n, joints, v, bits);
  keep_within(n, joints, T, sent.data() + n, v, bits);
  for (int i = 0; i < n;
      ++i) {  // a speed given with a position must match it within one step of acceleration
    const double apart = joints[i].a * T;
    f[i] = q_ref && qd_ref ? std::min(std::max(qd_ref[i], v[i] - apart), v[i] + apart) : v[i];
  }
  if (q_ref && qd_ref) scale(n, joints, f, bits);
  keep_within(n, joints, T, sent.data() + 2 * n, f, bits);
  for (int i = 0; i < n; ++i) {
    const Joint &joint = joints[i];
    const double free = q_ref && reached[i] && v[i] == wanted[i] ? q_ref[i] : joint.q + v[i] * T;
    moved[i] =
        std::min(std::max(free, std::min(joint.q_min, joint.q)), std::max(joint.q_max, joint.q));
    if (moved[i] != free) v[i] = (moved[i] - joint.q) / T;
  }
  for (const nb::object &array : {out, bits_array})
    PyArray_CLEARFLAGS(as_array(array), NPY_ARRAY_WRITEABLE);
  return nb::make_tuple(out, bits_array, ratio, refused);
}

// The index of the largest number, or of the first NaN.
template <class Values>
int largest(int n, const Values &values) {
  int found = 0;
  for (int i = 0; i < n; ++i) {
    if (std::isnan(values(i))) return i;
    if (values(i) > values(found)) found = i;
  }
  return found;
}

// i (from 1) if joint i is outside its range, -i if it moved too far, otherwise 0.
int implausible(nb::handle q_, nb::handle before_, nb::handle bounds_, double margin, double step,
    double seconds) {
  const Input given(q_, "q"), bounds(bounds_, "bounds");
  const int n = static_cast<int>(given.size());
  given.require_exactly({n}), bounds.require_exactly({3, n});
  const Optional last(before_, "before", n);
  if (n == 0) return 0;
  const double *q = given.data(), *low = bounds.data(), *high = low + n, *fastest = high + n;
  const auto beyond = [&](int i) { return std::max(low[i] - q[i], q[i] - high[i]); };
  const int out = largest(n, beyond);
  if (!(beyond(out) <= margin)) return out + 1;
  if (!last.data) return 0;
  const auto excess = [&](int i) {
    return std::fabs(q[i] - last.data[i]) - (step + fastest[i] * seconds);
  };
  const int far = largest(n, excess);
  return excess(far) <= 0.0 ? 0 : -(far + 1);
}

nb::tuple following_error(nb::handle q_, nb::handle reference_, nb::handle speed_,
    nb::handle fastest_, nb::handle allowed_, double kept, double lag) {
  const Input q(q_, "q");
  const int n = static_cast<int>(q.size());
  const Input reference(reference_, "reference", {n}), speed(speed_, "speed", {n}),
      before(fastest_, "fastest", {n}), allowed(allowed_, "allowed", {n});
  const nb::object out = fresh_array({n});
  double *fastest = numbers(out);
  for (int i = 0; i < n; ++i)
    fastest[i] = std::max(kept * before.data()[i], std::fabs(speed.data()[i]));
  const auto excess = [&](int i) {
    return std::fabs(reference.data()[i] - q.data()[i]) - (allowed.data()[i] + lag * fastest[i]);
  };
  const int worst = largest(n, excess);
  return nb::make_tuple(out, worst, n == 0 || excess(worst) <= 0.0);
}

nb::object filtered_velocity(
    nb::handle q_, nb::handle last_, nb::handle velocity_, double dt, double cutoff) {
  const Input q(q_, "q");
  const Input last(last_, "last", {q.size()}), velocity(velocity_, "velocity", {q.size()});
  const nb::object out = fresh_array({q.size()});
  const double share = 1.0 - std::exp(-2.0 * M_PI * cutoff * dt);
  for (npy_intp i = 0; i < q.size(); ++i) {
    const double before = velocity.data()[i];
    numbers(out)[i] = before + share * ((q.data()[i] - last.data()[i]) / dt - before);
  }
  PyArray_CLEARFLAGS(as_array(out), NPY_ARRAY_WRITEABLE);
  return out;
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_limits(nb::module_ &m) {
  m.def("limit_reference", &limit_reference, array("sent"), array("bounds"), arg("period"),
      arg("q_ref").none() = nb::none(), arg("q_last").none() = nb::none(),
      arg("qd_ref").none() = nb::none(), arg("lag") = 0.0,
      "Return the reference to send next, clamp bits, velocity ratio and refusal; see "
      "tests/oracles/limits.py.");
  m.def("implausible", &implausible, array("q"), arg("before").none(), array("bounds"),
      arg("margin"), arg("step"), arg("seconds"), "See _native.pyi.");
  m.def("following_error", &following_error, array("q"), array("reference"), array("speed"),
      array("fastest"), array("allowed"), arg("kept"), arg("lag"), "See _native.pyi.");
  m.def("filtered_velocity", &filtered_velocity, array("q"), array("last"), array("velocity"),
      arg("dt"), arg("cutoff"), "See _native.pyi.");
}
