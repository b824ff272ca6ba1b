// Depth buffer of a triangle mesh.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

namespace sigmasplat {

struct ProjectedMesh {                     // pixel coordinates and depth of the vertices; three vertices per face
    const double *u, *v, *z;
    const int* faces;
    size_t count;
};

// Depth of the nearest face at each pixel, 0 without a face, and its number, -1 without one. Of faces at the same depth
// the first one wins. 1/z is affine over the image of a plane. A face with a vertex at most near_m away is left out.
inline void mesh_depth(const ProjectedMesh& mesh, int width, int height, double near_m, float* depth, int* face) {
    const size_t pixels = size_t(width) * height;
    std::fill(depth, depth + pixels, std::numeric_limits<float>::infinity());
    std::fill(face, face + pixels, -1);
    for (size_t f = 0; f < mesh.count; ++f) {
        const int* corner = mesh.faces + 3 * f;
        double u[3], v[3], per_z[3];
        bool ahead = true;
        for (int k = 0; k < 3; ++k) {
            u[k] = mesh.u[corner[k]];
            v[k] = mesh.v[corner[k]];
            ahead = ahead && mesh.z[corner[k]] > near_m;
            per_z[k] = 1.0 / mesh.z[corner[k]];
        }
        if (!ahead) continue;
        const double left = std::max(std::ceil(std::min({u[0], u[1], u[2]})), 0.0);
        const double right = std::min(std::floor(std::max({u[0], u[1], u[2]})), width - 1.0);
        const double top = std::max(std::ceil(std::min({v[0], v[1], v[2]})), 0.0);
        const double bottom = std::min(std::floor(std::max({v[0], v[1], v[2]})), height - 1.0);
        if (!(left <= right && top <= bottom)) continue;
        const double du1 = u[1] - u[0], du2 = u[2] - u[0], dv1 = v[1] - v[0], dv2 = v[2] - v[0];
        const double double_area = du1 * dv2 - du2 * dv1;
        if (!(std::abs(double_area) > 1e-12)) continue;
        const double per_area = 1.0 / double_area, slack = 1e-9;
        const double slope1 = per_z[1] - per_z[0], slope2 = per_z[2] - per_z[0];
        for (int y = int(top); y <= int(bottom); ++y)
            for (int x = int(left); x <= int(right); ++x) {
                const double dx = x - u[0], dy = y - v[0];
                const double second = (dx * dv2 - dy * du2) * per_area, third = (dy * du1 - dx * dv1) * per_area;
                if (second < -slack || third < -slack || second + third > 1.0 + slack) continue;
                const float z = 1.0f / float(per_z[0] + second * slope1 + third * slope2);
                const size_t at = size_t(y) * width + x;
                if (z < depth[at]) {
                    depth[at] = z;
                    face[at] = int(f);
                }
            }
    }
    for (size_t at = 0; at < pixels; ++at)
        if (face[at] < 0) depth[at] = 0.0f;
}

}  // namespace sigmasplat
