#include "math/motion/signals.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace armlab {
namespace {

constexpr double gap_factor = 1.5;

bool finite(std::size_t n, const double *x) {
  return std::all_of(x, x + n, [](double value) { return std::isfinite(value); });
}

}  // namespace

SignalOperator::SignalOperator(
    SignalKind kind, double a, double b, double dt, std::vector<double> init)
    : kind_(kind), a_(a), b_(b), dt_(dt) {
  reset(std::move(init));
}

std::vector<double> SignalOperator::memory() const {
  std::vector<double> all{double(kind_), a_, b_, dt_, double(started_), double(stamped_), clock_,
      waiting_, nominal_, h_, double(gaps), double(skipped), longest_gap};
  all.insert(all.end(), c_, c_ + 4);
  for (const std::vector<double> *part : {&init_, &x_, &y_, &v_}) {
    all.push_back(double(part->size()));
    all.insert(all.end(), part->begin(), part->end());
  }
  return all;
}

SignalOperator SignalOperator::of_memory(const std::vector<double> &memory) {
  std::size_t at = 0;
  const auto next = [&] { return memory.at(at++); };  // throws beyond the end
  const auto kind = static_cast<SignalKind>(int(next()));
  const double a = next(), b = next(), dt = next();
  SignalOperator made(kind, a, b, dt, {});
  made.started_ = next() != 0.0;
  made.stamped_ = next() != 0.0;
  for (double *value : {&made.clock_, &made.waiting_, &made.nominal_, &made.h_}) *value = next();
  made.gaps = long(next());
  made.skipped = long(next());
  made.longest_gap = next();
  for (double &c : made.c_) c = next();
  for (std::vector<double> *part : {&made.init_, &made.x_, &made.y_, &made.v_}) {
    const auto count = static_cast<std::size_t>(next());
    for (std::size_t i = 0; i < count; ++i) part->push_back(next());
  }
  return made;
}

void SignalOperator::reset(std::vector<double> init) {
  init_ = std::move(init);
  x_.clear();
  started_ = false;
  gaps = skipped = 0;
  longest_gap = waiting_ = 0.0;
  nominal_ = std::isnan(dt_) ? 0.0 : dt_;
}

SignalStatus SignalOperator::step(std::size_t n, const double *x, const double *t, double *out) {
  if (!t && std::isnan(dt_)) return SignalStatus::time_missing;
  if (started_ && (t != nullptr) != stamped_)
    return t ? SignalStatus::time_unexpected : SignalStatus::time_missing;
  if (!finite(n, x) || (t && !std::isfinite(*t))) {
    std::fill(out, out + n, std::numeric_limits<double>::quiet_NaN());
    ++skipped;
    if (started_ && !t) waiting_ += dt_;
    return SignalStatus::ok;
  }
  if (!started_) {
    begin(n, x, out);
    stamped_ = t != nullptr;
  } else {
    const double h = t ? *t - clock_ : dt_ + waiting_;
    if (!(h > 0.0)) return SignalStatus::time_backward;
    note_gap(h);
    advance(h, x, out);
    std::copy(x, x + n, x_.begin());
  }
  waiting_ = 0.0;
  if (t) clock_ = *t;
  return SignalStatus::ok;
}

void SignalOperator::note_gap(double h) {
  if (nominal_ == 0.0) nominal_ = h;
  if (h <= gap_factor * nominal_ * (1.0 + 1e-9)) return;
  ++gaps;
  longest_gap = std::max(longest_gap, h);
}

// First sample: operators with memory take a step of dt from `init`; the others start at it.
void SignalOperator::begin(std::size_t n, const double *x, double *out) {
  const auto initial = [this](std::size_t i) { return init_[init_.size() == 1 ? 0 : i]; };
  const bool given = !init_.empty(), timed = !std::isnan(dt_);
  started_ = true;
  x_.assign(x, x + n);
  y_.assign(n, 0.0);
  v_.assign(n, 0.0);
  for (std::size_t i = 0; i < n; ++i)
    y_[i] = given ? initial(i) : kind_ <= SignalKind::difference ? 0.0 : x[i];
  if (kind_ == SignalKind::difference && given) {
    for (std::size_t i = 0; i < n; ++i) y_[i] = timed ? (x[i] - initial(i)) / dt_ : 0.0;
  } else if ((kind_ == SignalKind::euler || (kind_ == SignalKind::exponential && given)) && timed) {
    advance(dt_, x, out);
  }
  for (std::size_t i = 0; i < n; ++i) out[i] = output(i, x[i]);
}

void SignalOperator::set_coefficients(double h) {
  h_ = h;
  if (kind_ == SignalKind::exponential) {
    c_[0] = std::exp(-h / a_);
    return;
  }
  const double w = a_ * std::sqrt(1.0 - b_ * b_), decay = std::exp(-b_ * a_ * h);
  const double c = decay * std::cos(w * h), s = decay * std::sin(w * h) / w;
  c_[0] = c + b_ * a_ * s;
  c_[1] = s;
  c_[2] = -a_ * a_ * s;
  c_[3] = c - b_ * a_ * s;
}

void SignalOperator::advance(double h, const double *x, double *out) {
  const std::size_t n = x_.size();
  if (kind_ > SignalKind::difference && h != h_) set_coefficients(h);
  const double lag = kind_ > SignalKind::exponential ? 2.0 * b_ / a_ : 0.0;
  for (std::size_t i = 0; i < n; ++i) {
    if (kind_ == SignalKind::trapezoid) {
      y_[i] += 0.5 * h * (x[i] + x_[i]);
    } else if (kind_ == SignalKind::euler) {
      y_[i] += h * x[i];
    } else if (kind_ == SignalKind::difference) {
      y_[i] = (x[i] - x_[i]) / h;
    } else if (kind_ == SignalKind::exponential) {
      y_[i] = c_[0] * y_[i] + (1.0 - c_[0]) * x[i];
    } else {
      const double slope = (x[i] - x_[i]) / h, late = lag * slope;
      const double e = y_[i] - x_[i] + late, u = v_[i] - slope;
      y_[i] = c_[0] * e + c_[1] * u + x[i] - late;
      v_[i] = c_[2] * e + c_[3] * u + slope;
    }
    out[i] = output(i, x[i]);
  }
}

double SignalOperator::output(std::size_t i, double x) const {
  if (kind_ == SignalKind::slope) return v_[i];
  return kind_ == SignalKind::notch ? x - 2.0 * b_ / a_ * v_[i] : y_[i];
}

}  // namespace armlab
