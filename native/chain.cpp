// First version: forward kinematics.
#include <cmath>
#include <vector>

#include "arrays.h"

namespace armlab {

struct Chain {
  int n;
  std::vector<double> frames;
  std::vector<char> prismatic;
};

static void multiply(const double *a, const double *b, double *out) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 4; ++j)
      out[4 * i + j] = a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j] + (j == 3 ? a[4 * i + 3] : 0.0);
  out[12] = out[13] = out[14] = 0.0;
  out[15] = 1.0;
}

static void forward(const Chain &chain, const double *q, double *T) {
  double work[16];
  std::copy(chain.frames.begin(), chain.frames.begin() + 16, T);
  for (int i = 0; i < chain.n; ++i) {
    const double c = chain.prismatic[i] ? 1.0 : std::cos(q[i]), s = chain.prismatic[i] ? 0.0 : std::sin(q[i]);
    const double d = chain.prismatic[i] ? q[i] : 0.0;
    for (int k = 0; k < 3; ++k) {
      double *row = T + 4 * k;
      const double x = row[0], y = row[1];
      row[0] = c * x + s * y;
      row[1] = c * y - s * x;
      row[3] += d * row[2];
    }
    multiply(T, &chain.frames[16 * (i + 1)], work);
    std::copy(work, work + 16, T);
  }
}

}  // namespace armlab

void bind_chain(nb::module_ &m) {
  using namespace armlab;
  nb::class_<Chain>(m, "Chain")
      .def("__init__",
           [](Chain *self, nb::handle frames, nb::handle prismatic) {
             Input f(frames, "frames"), p(prismatic, "prismatic");
             p.require_tail({p.size()}, true);
             const int n = static_cast<int>(p.size());
             f.require_tail({n + 1, 4, 4}, true);
             new (self) Chain{n, {f.data(), f.data() + f.size()}, {}};
             for (int i = 0; i < n; ++i) self->prismatic.push_back(p.data()[i] != 0.0);
           },
           nb::arg("frames"), nb::arg("prismatic"))
      .def_prop_ro("n", [](const Chain &self) { return self.n; })
      .def(
          "forward",
          [](const Chain &self, nb::handle q_, nb::handle out) {
            Input q(q_, "q");
            q.require_tail({self.n});
            Batch batch(q, 1);
            Output T(out, "out", batch, {4, 4}, {&q});
            {
              BatchWithoutGil released(batch.count);
              for (npy_intp k = 0; k < batch.count; ++k) forward(self, q.data() + k * self.n, T.data() + 16 * k);
            }
            return T.take();
          },
          nb::arg("q"), nb::arg("out") = nb::none());
}
