#include "math/motion/obstacles.h"

#include <limits>
#include <utility>

#include "math/arm/kinematics.h"

namespace armlab {
namespace {

constexpr double pi = 3.141592653589793;
constexpr double steering = 12.0, turn = 20.0 / pi;  // 1/s per rad; 1/rad (Hoffmann et al. 2009)
constexpr double pushing = 0.15;                     // m^2/s
constexpr double slowest = 15.0, fastest = 200.0;    // 1/s: rates of the clearance guard
constexpr double slide = 0.3;                        // share of the guard along the surface
constexpr double still = 1e-9;                       // m/s
constexpr double straight = 1e-9;                    // sine of an angle
constexpr double apart = 1e-3;                       // m: shortest usable way along a surface
constexpr double parallel =
    1e-24;                        // squared sine below which axes are parallel except for rounding
constexpr double damping = 0.02;  // m/rad: damping in directions in which an arm hardly moves
constexpr int sweeps = 8;         // passes of the guard over all contacts

double length(const Point &a) { return std::sqrt(dot(a, a)); }
double clamped(double x, double low, double high) { return std::min(std::max(x, low), high); }
Point point_of(const double *y, int axes) { return {y[0], y[1], axes == 3 ? y[2] : 0.0}; }

// A unit vector perpendicular to v, chosen deterministically.
Point across(const Point &v, int axes) {
  const double size[3] = {std::fabs(v.x), std::fabs(v.y), std::fabs(v.z)};
  const int i = static_cast<int>(std::min_element(size, size + axes) - size);
  const Point e{i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0, i == 2 ? 1.0 : 0.0};
  const double square = dot(v, v);
  const Point side = square > 0.0 ? e - (dot(e, v) / square) * v : e;
  return (1.0 / length(side)) * side;
}

// Parameters of the nearest points of two segments.
std::pair<double, double> shares(const Capsule &one, const Capsule &two) {
  const Point d1 = one.b - one.a, d2 = two.b - two.a, r = one.a - two.a;
  const double a = dot(d1, d1), e = dot(d2, d2), c = dot(d1, r), f = dot(d2, r);
  if (a == 0.0) return {0.0, e == 0.0 ? 0.0 : clamped(f / e, 0.0, 1.0)};
  if (e == 0.0) return {clamped(-c / a, 0.0, 1.0), 0.0};
  const Point normal = cross(d1, d2);  // square: a e - b^2, but accurate near parallel
  const double b = dot(d1, d2), square = dot(normal, normal);
  const double s =
      square > parallel * a * e ? clamped(dot(normal, cross(d2, r)) / square, 0.0, 1.0) : 0.0;
  const double t = (b * s + f) / e;
  if (t < 0.0) return {clamped(-c / a, 0.0, 1.0), 0.0};
  if (t > 1.0) return {clamped((b - c) / a, 0.0, 1.0), 1.0};
  return {s, t};
}

}  // namespace

Obstacles::Obstacles(int n, Rule rule) : n_(n), axes_(n), rule_(rule), bodies_{{0, {}}}, j_(n) {}

Obstacles::Obstacles(const Chain &arm, std::vector<Body> bodies, Rule rule)
    : n_(arm.n),
      axes_(3),
      rule_(rule),
      arm_(arm),
      bodies_(std::move(bodies)),
      frames_(arm.n),
      at_goal_(arm.n),
      motions_(arm.n),
      j_(arm.n) {}

void Obstacles::place(std::vector<Capsule> capsules) {
  obstacles_ = std::move(capsules);
  contacts_.reserve(obstacles_.size() * bodies_.size());
}

void Obstacles::advance(double dt) {
  for (Capsule &one : obstacles_) {
    one.a = one.a + dt * one.velocity;
    one.b = one.b + dt * one.velocity;
  }
}

void Obstacles::locate(const double *y, std::vector<Pose<double>> &frames) const {
  for (int i = 0; i < n_; ++i) {
    const Pose<double> step = link_pose(*arm_, i, y[i]);
    frames[i] = i == 0 ? step : frames[i - 1] * step;
  }
}

// Forward Newton-Euler recursion over the links, without joint accelerations.
void Obstacles::move(const double *yd) {
  const Point zero{0.0, 0.0, 0.0};
  Motion last{zero, zero, zero, zero};
  for (int i = 0; i < n_; ++i) {
    const Point r = i == 0 ? zero : frames_[i].p - frames_[i - 1].p, rate = yd[i] * frames_[i].z;
    Motion now{last.v + cross(last.w, r), last.w,
        last.a + cross(last.turn, r) + cross(last.w, cross(last.w, r)), last.turn};
    if (arm_->steps[i].slides) {
      now.v = now.v + rate;
      now.a = now.a + 2.0 * cross(last.w, rate);
    } else {
      now.w = now.w + rate;
      now.turn = now.turn + cross(last.w, rate);
    }
    motions_[i] = last = now;
  }
}

Obstacles::Contact Obstacles::nearest(const Body &body, const Capsule &obstacle) const {
  Capsule shape = body.shape;
  if (body.link > 0) {
    const Pose<double> &T = frames_[body.link - 1];
    shape.a = T.p + T.turn(shape.a);
    shape.b = T.p + T.turn(shape.b);
  }
  const auto [s, t] = shares(shape, obstacle);
  const Point p = shape.a + s * (shape.b - shape.a),
              way = p - (obstacle.a + t * (obstacle.b - obstacle.a));
  const double gap = length(way);
  const Point away = gap > 0.0 ? (1.0 / gap) * way : across(obstacle.b - obstacle.a, axes_);
  return {body.link, &obstacle, gap - obstacle.radius - shape.radius, p, away, {}, {}};
}

double Obstacles::distance(const double *y) {
  if (arm_) locate(y, frames_);
  else bodies_[0].shape.a = bodies_[0].shape.b = point_of(y, axes_);
  double least = std::numeric_limits<double>::infinity();
  for (const Body &body : bodies_)
    for (const Capsule &obstacle : obstacles_) {
      const double d = nearest(body, obstacle).distance;
      if (std::isnan(d)) return d;
      least = std::min(least, d);
    }
  return least;
}

bool Obstacles::acts(const double *y) { return distance(y) < rule_.reach; }

// Finds the pairs within reach; the bodies are at the positions set by `distance`.
void Obstacles::find(const double *yd) {
  contacts_.clear();
  if (arm_) move(yd);
  for (const Body &body : bodies_)
    for (const Capsule &obstacle : obstacles_) {
      Contact found = nearest(body, obstacle);
      if (!(found.distance < rule_.reach)) continue;
      found.velocity = arm_ ? Point{} : point_of(yd, axes_);
      if (arm_) {
        const Motion &m = motions_[body.link - 1];
        const Point r = found.p - frames_[body.link - 1].p;
        found.velocity = m.v + cross(m.w, r);
        found.drift = m.a + cross(m.turn, r) + cross(m.w, cross(m.w, r));
      }
      found.velocity = found.velocity - obstacle.velocity;
      contacts_.push_back(found);
    }
}

// Computes j = e^T J of the contact point; returns its damped square.
double Obstacles::row(const Contact &contact, const Point &e, double *j) const {
  if (!arm_) {
    j[0] = e.x;
    j[1] = e.y;
    if (axes_ == 3) j[2] = e.z;
    return 1.0;
  }
  double square = damping * damping;
  for (int i = 0; i < n_; ++i) {
    const Pose<double> &T = frames_[i];
    const Point column = arm_->steps[i].slides ? T.z : cross(T.z, contact.p - T.p);
    j[i] = i < contact.link ? dot(e, column) : 0.0;
    square += j[i] * j[i];
  }
  return square;
}

void Obstacles::push(const Contact &contact, const Point &e, double amount, double *ydd) {
  const double share = amount / row(contact, e, j_.data());
  for (int i = 0; i < n_; ++i) ydd[i] += share * j_[i];
}

Point Obstacles::steer(const Contact &c) const {
  const double speed = length(c.velocity);
  if (speed < still) return {0.0, 0.0, 0.0};
  const double u = clamped((rule_.reach - c.distance) / (rule_.reach - rule_.clearance), 0.0, 1.0);
  const double weight = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
  const double cosine = clamped(-dot(c.away, c.velocity) / speed, -1.0, 1.0);
  Point side = c.away + (cosine / speed) * c.velocity;  // `away` normal to the velocity
  const double sine = length(side);
  side = sine > straight ? (1.0 / sine) * side : across(c.velocity, axes_);
  if (rule_.form == Form::steering) {
    const double theta = std::atan2(sine, cosine);  // the arc cosine is inaccurate at small angles
    return (weight * steering * theta * std::exp(-turn * theta) * speed) * side;
  }
  if (cosine <= 0.0) return {0.0, 0.0, 0.0};
  const double near = std::max(c.distance, 0.1 * rule_.reach);
  const Point force = (2.0 * sine) * side + cosine * c.away;
  return (weight * pushing * cosine * speed / (near * near)) * force;
}

// The additional acceleration away from an obstacle that keeps the clearance.
double Obstacles::missing(const Contact &c, const double *ydd) {
  const double h = c.distance - rule_.clearance, rate = dot(c.away, c.velocity);
  const double k = h > 0.0 && -rate > slowest * h ? std::min(-rate / h, fastest) : slowest;
  row(c, c.away, j_.data());
  double a = dot(c.away, c.drift);
  for (int i = 0; i < n_; ++i) a += j_[i] * ydd[i];
  return -2.0 * k * rate - k * k * h - a;
}

// A unit vector along the surface, towards the nearer end of the obstacle or the goal.
Point Obstacles::along(const Contact &c, const double *g) {
  if (!knows_goal_ && arm_) locate(g, at_goal_);
  knows_goal_ = true;
  Point goal = arm_ ? Point{} : point_of(g, axes_);
  if (arm_) {  // position of the same point of the body at the goal
    const Pose<double> &now = frames_[c.link - 1], &then = at_goal_[c.link - 1];
    goal = then.p + then.turn(now.turn_back(c.p - now.p));
  }
  for (const Point &way : {c.p - 0.5 * (c.obstacle->a + c.obstacle->b), goal - c.p}) {
    const Point part = way - dot(way, c.away) * c.away;
    const double size = length(part);
    if (size > apart) return (1.0 / size) * part;
  }
  return across(c.away, axes_);
}

void Obstacles::add(const double *y, const double *yd, const double *g, double *ydd) {
  if (!acts(y)) return;
  find(yd);
  knows_goal_ = false;
  for (const Contact &c : contacts_) {
    const Point wanted = steer(c);
    const double size = length(wanted);
    if (size > 0.0) push(c, (1.0 / size) * wanted, size, ydd);
  }
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    bool kept = true;
    for (const Contact &c : contacts_) {
      const double lacks = missing(c, ydd);
      if (!(lacks > 0.0)) continue;
      kept = false;
      push(c, c.away, lacks, ydd);
      if (sweep == 0) push(c, along(c, g), slide * lacks, ydd);
    }
    if (kept) break;
  }
}

}  // namespace armlab
