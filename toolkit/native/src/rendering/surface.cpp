// Depth of the surface in a rendered view.
#include "rendering/surface.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace semsplat {

// Front-to-back compositing gives the nearer of two overlapping Gaussians more weight. On a slanted
// surface, the mean depth is therefore that of a point up to half a pixel away from the ray. The mean
// of the centres is on the surface, so the depth is computed by intersecting the ray with the plane
// through it.
void surface_depth(const Pinhole& camera, const double* T, const float* images, const float* centres,
                   float min_silhouette, float* depth) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    float R[9], t[3];
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) R[3 * i + j] = (float)T[4 * i + j];
        t[i] = (float)T[4 * i + 3];
    }
    std::vector<float> points(3 * plane);
    // The neighbours are two pixels apart in both directions; times z^2 this is the shortest normal.
    const float footprint = 4.0f * MIN_NORMAL / (camera.fx * camera.fy);
#pragma omp parallel
    {
#pragma omp for schedule(static)
        for (int y = 0; y < H; ++y) {
            for (int x = 0; x < W; ++x) {
                const size_t i = (size_t)y * W + x;
                const float s = images[SILHOUETTE * plane + i], inverse = s >= min_silhouette ? 1.0f / s : 0.0f;
                const float a = centres[i] * inverse, b = centres[plane + i] * inverse,
                            c = centres[2 * plane + i] * inverse;
                for (int k = 0; k < 3; ++k) {
                    points[3 * i + k] = inverse > 0 ? R[3 * k] * a + R[3 * k + 1] * b + R[3 * k + 2] * c + t[k] : 0.0f;
                }
            }
        }
#pragma omp for schedule(static)
        for (int y = 0; y < H; ++y) {
            for (int x = 0; x < W; ++x) {
                const size_t i = (size_t)y * W + x;
                const float* p = points.data() + 3 * i;
                depth[i] = p[2];
                if (!(p[2] > 0) || x == 0 || y == 0 || x == W - 1 || y == H - 1) continue;
                const float *l = p - 3, *r = p + 3, *o = p - 3 * W, *u = p + 3 * W;
                if (!(std::min(std::min(l[2], r[2]), std::min(o[2], u[2])) > 0)) continue;
                if (!same_surface(l[2], p[2], r[2]) || !same_surface(o[2], p[2], u[2])) continue;
                const float ax = r[0] - l[0], ay = r[1] - l[1], az = r[2] - l[2];
                const float bx = u[0] - o[0], by = u[1] - o[1], bz = u[2] - o[2];
                const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
                const float shortest = footprint * p[2] * p[2];
                if (nx * nx + ny * ny + nz * nz < shortest * shortest) continue;
                const float rx = (x - camera.cx) / camera.fx, ry = (y - camera.cy) / camera.fy;
                const float z = (nx * p[0] + ny * p[1] + nz * p[2]) / (nx * rx + ny * ry + nz);
                // The intersection with a plane nearly parallel to the ray is not reliable.
                if (std::fabs(z - p[2]) < MAX_SURFACE_CORRECTION * p[2]) depth[i] = z;
            }
        }
    }
}

}  // namespace semsplat
