// One step of the momentum filter; tests/oracles/momentum.py states the mathematics.
#pragma once

#include "math/arm/chain.h"

namespace armlab {

constexpr int max_inputs = max_joints + 6;
constexpr int max_states = max_joints + max_inputs;

// Of a leak a over a step h, phi(s) = (1 - e^(-a s)) / a: e^(-a h), phi(h), and the integrals over
// the step of e^(-2 a s), phi e^(-a s), phi^2.
struct Leak {
  double decay, phi, zz, pz, pp;
};
Leak leak_integrals(double a, double h);

struct MomentumInputs {
  int n, m;
  const double *G;           // (n, m)
  const double *Qp, *q, *a;  // (n), (m), (m)
};

// x (n + m) and P (n + m, n + m), row by row, in place; u, y (n), R (n, n). `work` holds 4 (n +
// m)^2 numbers. False when the innovation has no positive covariance; then x and P are as they
// came.
bool momentum_step(const MomentumInputs &inputs, const double *u, const double *y, const double *R,
    double h, double *x, double *P, double *work);

}  // namespace armlab
