// Obstacle avoidance during a motion. Specification: docs/theory/obstacles.md.
#pragma once

#include <optional>

#include "math/arm/chain.h"
#include "math/motion/primitive.h"

namespace armlab {

using Point = Vec3<double>;

struct Capsule {
  Point a, b;
  double radius;
  Point velocity;
};

class Obstacles : public Coupling {
 public:
  enum class Form { steering, potential };
  // On link 1 ... n of the arm, in the axes of the link. Without an arm: link 0, a point.
  struct Body {
    int link;
    Capsule shape;
  };
  struct Rule {
    double clearance, reach;
    Form form;
  };

  Obstacles(int n, Rule rule);  // coordinates: a point in the plane or in space
  Obstacles(const Chain &arm, std::vector<Body> bodies, Rule rule);

  void place(std::vector<Capsule> capsules);
  double distance(const double *y);  // least distance of surfaces; infinite without obstacles

  bool acts(const double *y) override;
  void add(const double *y, const double *yd, const double *g, double *ydd) override;
  void advance(double dt) override;

  int n() const { return n_; }

 private:
  // The nearest points of a body and an obstacle: p on the body, velocity relative to it.
  struct Contact {
    int link;
    const Capsule *obstacle;
    double distance;
    Point p, away, velocity, drift;
  };
  struct Motion {  // link frame's origin and axes, without joint accelerations
    Point v, w, a, turn;
  };

  void locate(const double *y, std::vector<Pose<double>> &frames) const;
  Contact nearest(const Body &body, const Capsule &obstacle) const;
  void move(const double *yd);
  void find(const double *yd);
  double row(const Contact &contact, const Point &e, double *j) const;
  void push(const Contact &contact, const Point &e, double amount, double *ydd);
  Point steer(const Contact &contact) const;
  double missing(const Contact &contact, const double *ydd);
  Point along(const Contact &contact, const double *g);

  int n_, axes_;  // coordinates; dimensions of space
  Rule rule_;
  std::optional<Chain> arm_;
  std::vector<Body> bodies_;
  std::vector<Capsule> obstacles_;
  std::vector<Contact> contacts_;
  std::vector<Pose<double>> frames_, at_goal_;
  std::vector<Motion> motions_;
  std::vector<double> j_;
  bool knows_goal_ = false;
};

}  // namespace armlab
