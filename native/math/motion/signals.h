// Streaming operators on signals. Specification: tests/oracles/signals.py.
#pragma once

#include <cstddef>
#include <vector>

namespace armlab {

enum class SignalKind { trapezoid, euler, difference, exponential, lowpass, slope, notch };

enum class SignalStatus { ok, time_backward, time_missing, time_unexpected };

class SignalOperator {
 public:
  // a: time constant of `exponential`, or angular corner frequency of the oscillators; b: their
  // damping ratio. dt: nominal step, NaN if every sample has a time stamp. init: no value, one
  // value or n values.
  SignalOperator(SignalKind kind, double a, double b, double dt, std::vector<double> init);

  // Restores an operator from `memory`, for copies in other processes.
  static SignalOperator of_memory(const std::vector<double> &memory);
  std::vector<double> memory() const;

  void reset(std::vector<double> init);
  const std::vector<double> &init() const { return init_; }
  std::size_t channels() const { return x_.size(); }  // 0 before the first sample

  // Processes one sample of n channels; t is never NaN, and null without time stamps. out must not
  // overlap x.
  SignalStatus step(std::size_t n, const double *x, const double *t, double *out);

  long gaps = 0, skipped = 0;
  double longest_gap = 0.0;

 private:
  void begin(std::size_t n, const double *x, double *out);
  void advance(double h, const double *x, double *out);
  void set_coefficients(double h);
  double output(std::size_t i, double x) const;
  void note_gap(double h);

  SignalKind kind_;
  double a_, b_, dt_;
  std::vector<double> init_, x_, y_, v_;  // last input; output or position; velocity
  bool started_ = false, stamped_ = false;
  double clock_ = 0.0, waiting_ = 0.0,
         nominal_ = 0.0;         // last stamp; time of skipped samples; usual step
  double h_ = -1.0, c_[4] = {};  // step of the coefficients; coefficients
};

}  // namespace armlab
