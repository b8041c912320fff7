// Torque of the drives at one instant: friction with its presliding state, and torque ripple. The only place in the
// compiled core that evaluates it; armlab/kernels/_reference/drive.py states the mathematics.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "chain.h"

namespace armlab {

struct JointFriction {
  double viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution, root, smooth_speed;
};
struct JointRipple {
  double cycles, cosine, sine;
};

// z <- s + (z - s) exp(-|dy| / delta), s = sign(dy).
inline double slide(double z, double dy, double delta) {
  if (dy == 0.0) return z;
  const double sign = dy > 0.0 ? 1.0 : -1.0;
  return sign + (z - sign) * std::exp(-std::fabs(dy) / delta);
}

// y follows q with a play of +-resolution; returns dy and moves y.
inline double follow(double &y, double q, double resolution) {
  const double moved = std::min(std::max(y, q - resolution), q + resolution);
  const double dy = moved - y;
  y = moved;
  return dy;
}

// What one joint remembers.
struct DriveState {
  double play = 0.0, z = 0.0;

  void start(double q) { play = q; }
};

class Drive {
 public:
  int n = 0;
  std::array<JointFriction, max_joints> friction;
  std::array<JointRipple, max_joints> ripple;

  // Moves the state of joint i to position q; returns the displacement that the encoder can tell.
  double move(int i, double q, DriveState &state) const {
    const double dy = follow(state.play, q, friction[i].resolution);
    state.z = slide(state.z, dy, friction[i].delta);
    return dy;
  }

  // Torque of joint i; the dry part (Coulomb, Stribeck, root) counts by `dry_share`.
  double torque(int i, double q, double qd, const DriveState &state, double dry_share) const {
    const JointFriction &f = friction[i];
    const JointRipple &r = ripple[i];
    const double slow = qd / f.stribeck_speed;
    const double s = f.smooth_speed > 0.0 ? std::tanh(qd / f.smooth_speed) : state.z;
    const double coulomb = f.coulomb_pos * std::max(s, 0.0) + f.coulomb_neg * std::min(s, 0.0);
    double dry = coulomb + f.stribeck * s * std::exp(-(slow * slow));
    if (f.root != 0.0) dry += f.root * s * std::sqrt(std::fabs(qd));
    return f.viscous * qd + dry_share * dry + f.offset + r.cosine * std::cos(r.cycles * q) + r.sine * std::sin(r.cycles * q);
  }

  // Largest friction at rest.
  double at_rest(int i) const {
    return 0.5 * (friction[i].coulomb_pos + friction[i].coulomb_neg) + std::max(friction[i].stribeck, 0.0);
  }
};

}  // namespace armlab
