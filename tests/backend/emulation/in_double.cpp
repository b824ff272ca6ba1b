// splat.h in double precision, as a library of C, for tests of the header itself.
#include <cmath>
#include <cstring>

namespace {
using std::sqrt;
inline double max(double a, double b) { return a > b ? a : b; }
inline double clamp(double a, double lo, double hi) { return a < lo ? lo : a > hi ? hi : a; }
inline bool ge(double a, double b) { return a >= b; }
inline bool both(bool a, bool b) { return a && b; }
inline double select(bool m, double a, double b) { return m ? a : b; }
inline double only(bool m, double a) { return m ? a : 0.0; }
#include "splat.h"
}  // namespace

extern "C" void project_double(int count, const double* view, const double* means, const double* quats, const double* scales,
                               const double* g, double* footprint, double* gradient) {
    View<double> v;
    memcpy(&v, view, sizeof v);
    for (int i = 0; i < count; i++) {
        Shape<double> s;
        memcpy(s.mean, means + 3 * i, sizeof s.mean);
        memcpy(s.quat, quats + 4 * i, sizeof s.quat);
        memcpy(s.scale, scales + 3 * i, sizeof s.scale);
        auto f = project(v, s, v.near_m);
        add_slopes(v, s, v.near_m, f);
        const double out[8] = {f.u, f.v, f.z, f.l1, f.l2, f.l3, f.slope_u, f.slope_v};
        memcpy(footprint + 8 * i, out, sizeof out);
        FootprintGradient<double> gf;
        memcpy(&gf, g + 8 * i, sizeof gf);
        ShapeGradient<double> gs;
        project_backward<true>(v, s, v.near_m, gf, gs);
        memcpy(gradient + 16 * i, &gs, sizeof gs);
    }
}
