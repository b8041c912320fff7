#include "math/arm/chain.h"

namespace armlab {
namespace {

constexpr double pi = 3.14159265358979323846;

// R = Rz(beta) Rx(alpha) Rz(gamma). For alpha near 0 or pi, beta is arbitrary. Alpha and gamma are
// therefore computed from Rz(-beta) R, which makes the product exact for any beta.
struct Angles {
  double beta, alpha, gamma;
};

Angles zxz(const double *E) {
  double beta = std::atan2(E[2], -E[6]);
  if (beta > pi / 2) beta -= pi;
  if (beta < -pi / 2) beta += pi;
  const double c = std::cos(beta), s = std::sin(beta);
  const double gamma = std::atan2(-(c * E[1] + s * E[5]), c * E[0] + s * E[4]);
  const double alpha = std::atan2(s * E[2] - c * E[6], E[10]);
  return {beta, alpha, gamma};
}

// Sets rounding errors to zero: entries of a rotation and lengths [m] are not accurate to 1e-15.
double without_rounding(double x) { return std::fabs(x) < 1e-15 ? 0.0 : x; }

Chain::Twist twist(const Chain::Step &step) {
  if (step.cos_alpha == 0.0)
    return step.sin_alpha > 0.0 ? Chain::Twist::quarter : Chain::Twist::minus_quarter;
  if (step.sin_alpha == 0.0 && step.cos_alpha > 0.0) return Chain::Twist::none;
  return Chain::Twist::other;
}

}  // namespace

Chain::Chain(int joints, const double *frames_, const bool *prismatic)
    : n(joints), frames{}, steps{} {
  std::copy(frames_, frames_ + 16 * (n + 1), frames.begin());
  double gamma_before = 0.0;
  for (int i = 0; i < n; ++i) {
    const double *E = frame(i + 1);
    const Angles angles = zxz(E);
    const double c = std::cos(angles.beta), s = std::sin(angles.beta);
    Step &step = steps[i];
    step.offset = std::remainder(gamma_before + angles.beta, 2 * pi);
    step.slides = prismatic[i];
    step.px = without_rounding(c * E[3] + s * E[7]);
    step.py = without_rounding(c * E[7] - s * E[3]);
    step.pz = E[11];
    step.has_x = step.px != 0.0;
    step.has_y = step.py != 0.0;
    step.has_z = step.pz != 0.0;
    step.cos_alpha = without_rounding(std::cos(angles.alpha));
    step.sin_alpha = without_rounding(std::sin(angles.alpha));
    step.twist = twist(step);
    gamma_before = angles.gamma;
  }
  cos_last = std::cos(gamma_before);
  sin_last = without_rounding(std::sin(gamma_before));
}

}  // namespace armlab
