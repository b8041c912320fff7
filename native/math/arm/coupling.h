// What adds to the acceleration of a movement primitive from outside of it.
#pragma once

namespace armlab {

class Coupling {
 public:
  virtual ~Coupling() = default;
  // Whether it may add anything at y (n).
  virtual bool acts(const double *y) = 0;
  // Adds to the acceleration ydd (n) of a motion at y with velocity yd on its way to g.
  virtual void add(const double *y, const double *yd, const double *g, double *ydd) = 0;
  // Time goes on, dt >= 0.
  virtual void advance(double dt) = 0;
};

}  // namespace armlab
