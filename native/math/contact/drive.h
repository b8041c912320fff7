// Torque of the drives at one instant: friction with its presliding and thermal states, friction
// over position, and torque ripple. No other code in the compiled core implements it; the
// specification is tests/oracles/drive.py.
#pragma once

#include <vector>

#include "math/arm/chain.h"

namespace armlab {

struct JointFriction {
  double viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution,
      root, smooth_speed, load;
};
constexpr int friction_rows = sizeof(JointFriction) / sizeof(double);
struct JointRipple {
  double cycles, cosine, sine;
};

// Warm-up by friction: coulomb (1 + of_coulomb x), viscous (1 + of_viscous x); x approaches
// power / reference with time constant `time`. time 0: constant friction.
struct JointWarmUp {
  double of_coulomb, of_viscous, time, reference, start;
};

constexpr int max_centres = 64;

// Normalised Gaussians exp(-((x - c) / w)^2). Their sum never vanishes, because x is clamped to the
// range of the centres.
inline void basis_weights(
    double x, int count, const double *centres, const double *widths, double *weights) {
  x = std::min(std::max(x, centres[0]), centres[count - 1]);
  double largest = -1e300, sum = 0.0;
  for (int k = 0; k < count; ++k) {
    const double u = (x - centres[k]) / widths[k];
    weights[k] = -(u * u);
    largest = std::max(largest, weights[k]);
  }
  for (int k = 0; k < count; ++k) sum += weights[k] = std::exp(weights[k] - largest);
  for (int k = 0; k < count; ++k) weights[k] /= sum;
}

// z <- s + (z - s) exp(-|dy| / delta), s = sign(dy).
inline double slide(double z, double dy, double delta) {
  if (dy == 0.0) return z;
  const double sign = dy > 0.0 ? 1.0 : -1.0;
  return sign + (z - sign) * std::exp(-std::fabs(dy) / delta);
}

// y follows q with a backlash of +-resolution; returns dy and updates y.
inline double follow(double &y, double q, double resolution) {
  const double moved = std::min(std::max(y, q - resolution), q + resolution);
  const double dy = moved - y;
  y = moved;
  return dy;
}

// State of one joint.
struct DriveState {
  double play = 0.0, z = 0.0, warmth = 0.0;
};

// Torque ripple with speed-dependent amplitudes (lines, sides, speeds, 2): cosine and sine.
struct RippleLines {
  int speeds = 0, sides = 1;                // two sides: one per direction, over |qd|
  std::vector<double> cycles;               // per line, in the order of the joints
  std::array<int, max_joints + 1> first{};  // first line of each joint
  std::vector<double> centres, widths;      // (n, speeds)
  std::vector<double> coefficients;
};

// Friction over position and speed: (n, 2, positions, speeds), positive direction first.
struct FrictionMap {
  int positions = 0, speeds = 0;
  std::vector<double> position_centres, position_widths, speed_centres, speed_widths, coefficients;
};

class Drive {
 public:
  int n = 0;
  std::array<JointFriction, max_joints> friction;
  std::array<JointRipple, max_joints> ripple;
  std::array<JointWarmUp, max_joints> warm_up{};
  RippleLines lines;
  FrictionMap map;

  // State of joint i at the first position of a record.
  DriveState start(int i, double q) const { return {q, 0.0, warm_up[i].start}; }

  // State after a gap with unknown motion: initial, except for the thermal state.
  static DriveState restart(double q, const DriveState &before) { return {q, 0.0, before.warmth}; }

  // Moves joint i to position q; returns the displacement resolved by the encoder.
  double move(int i, double q, DriveState &state) const {
    const double dy = follow(state.play, q, friction[i].resolution);
    state.z = slide(state.z, dy, friction[i].delta);
    return dy;
  }

  // Torque of joint i; `dry_share` scales the dry part (Coulomb, Stribeck, root).
  double torque(int i, double q, double qd, const DriveState &state, double dry_share) const {
    const JointRipple &r = ripple[i];
    const double s = sign(i, qd, state);
    double tau = rubbing(i, qd, s, state.warmth, dry_share) + friction[i].offset +
                 r.cosine * std::cos(r.cycles * q) + r.sine * std::sin(r.cycles * q);
    if (map.positions) tau += dry_share * mapped(i, q, qd, s);
    if (!lines.cycles.empty()) tau += rippled(i, q, qd, s);
    return tau;
  }

  // Load-dependent friction of joint i: load |x| s, with x the torque transmitted to the links. The
  // argument is either x, or y = x + load |x| s, the remainder of the motor torque.
  double of_load(int i, double x, double qd, const DriveState &state) const {
    const double load = friction[i].load;
    return load == 0.0 ? 0.0 : load * sign(i, qd, state) * std::fabs(x);
  }
  double of_passing(int i, double y, double qd, const DriveState &state, double dry_share) const {
    if (friction[i].load == 0.0) return 0.0;
    const double c = dry_share * friction[i].load * sign(i, qd, state);
    return c * std::fabs(y) / (1.0 + (y < 0.0 ? -c : c));
  }

  // Heats joint i by its friction power for a time dt.
  void heat(int i, double qd, double dt, DriveState &state) const {
    const JointWarmUp &w = warm_up[i];
    if (!(w.time > 0.0)) return;
    const double power =
        std::fabs(rubbing(i, qd, sign(i, qd, state), state.warmth, 1.0) * qd) / w.reference;
    state.warmth = power + (state.warmth - power) * std::exp(-dt / w.time);
  }

  // Derivatives of the friction of joint i with respect to its parameters: viscous, Coulomb in each
  // direction, offset, Stribeck, root, load.
  void columns(int i, double qd, double x, const DriveState &state, double *out) const {
    const double s = sign(i, qd, state), slow = qd / friction[i].stribeck_speed;
    const double made[] = {qd, std::max(s, 0.0), std::min(s, 0.0), 1.0,
        s * std::exp(-(slow * slow)), s * std::sqrt(std::fabs(qd)), s * std::fabs(x)};
    std::copy(std::begin(made), std::end(made), out);
  }

  // Largest friction at rest with load x.
  double at_rest(int i, double x) const {
    return 0.5 * (friction[i].coulomb_pos + friction[i].coulomb_neg) +
           std::max(friction[i].stribeck, 0.0) + friction[i].load * std::fabs(x);
  }

 private:
  double sign(int i, double qd, const DriveState &state) const {
    return friction[i].smooth_speed > 0.0 ? std::tanh(qd / friction[i].smooth_speed) : state.z;
  }

  // Dissipated power.
  double rubbing(int i, double qd, double s, double warmth, double dry_share) const {
    const JointFriction &f = friction[i];
    const double slow = qd / f.stribeck_speed;
    const double coulomb = f.coulomb_pos * std::max(s, 0.0) + f.coulomb_neg * std::min(s, 0.0);
    double dry = coulomb * (1.0 + warm_up[i].of_coulomb * warmth) +
                 f.stribeck * s * std::exp(-(slow * slow));
    if (f.root != 0.0) dry += f.root * s * std::sqrt(std::fabs(qd));
    return f.viscous * (1.0 + warm_up[i].of_viscous * warmth) * qd + dry_share * dry;
  }

  double mapped(int i, double q, double qd, double s) const {
    const int P = map.positions, S = map.speeds;
    double at[max_centres], along[max_centres], sum[2] = {0.0, 0.0};
    basis_weights(q, P, &map.position_centres[i * P], &map.position_widths[i * P], at);
    basis_weights(std::fabs(qd), S, &map.speed_centres[i * S], &map.speed_widths[i * S], along);
    const double *k = &map.coefficients[2 * P * S * i];
    for (int side = 0; side < 2; ++side)
      for (int a = 0; a < P; ++a)
        for (int b = 0; b < S; ++b) sum[side] += at[a] * along[b] * *k++;
    return 0.5 * (1.0 + s) * sum[0] + 0.5 * (1.0 - s) * sum[1];
  }

  double rippled(int i, double q, double qd, double s) const {
    if (lines.first[i] == lines.first[i + 1]) return 0.0;
    const int S = lines.speeds, K = S * lines.sides;
    double along[2 * max_centres], tau = 0.0;
    const double x = lines.sides == 2 ? std::fabs(qd) : qd;
    basis_weights(x, S, &lines.centres[i * S], &lines.widths[i * S], along);
    if (lines.sides == 2)
      for (int k = 0; k < S; ++k) {
        along[S + k] = 0.5 * (1.0 - s) * along[k];
        along[k] *= 0.5 * (1.0 + s);
      }
    for (int line = lines.first[i]; line < lines.first[i + 1]; ++line) {
      const double *c = &lines.coefficients[2 * K * line];
      double cosine = 0.0, sine = 0.0;
      for (int k = 0; k < K; ++k) {
        cosine += along[k] * c[2 * k];
        sine += along[k] * c[2 * k + 1];
      }
      tau += cosine * std::cos(lines.cycles[line] * q) + sine * std::sin(lines.cycles[line] * q);
    }
    return tau;
  }
};

}  // namespace armlab
