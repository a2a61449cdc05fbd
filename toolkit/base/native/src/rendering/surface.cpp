// Depth of the surface in a rendered view. The loops over the pixels of a row have no branches, so that
// the compiler vectorises them.
#include "rendering/surface.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "rendering/mean_centres.hpp"

namespace semsplat {
namespace {

// Rows of a thread's share of the image; the points of the rows around it are computed twice.
constexpr int BAND = 16;

// Depth of the inner pixels of a row, from the points [3, W] of it and of the rows above and below.
void intersect(const Pinhole& camera, int y, const float* above, const float* here, const float* below,
               float* __restrict depth) {
    const int W = camera.width;
    // The neighbours are two pixels apart in both directions; times z^2 this is the shortest normal.
    const float footprint = 4.0f * MIN_NORMAL / (camera.fx * camera.fy);
    const float ry = (y - camera.cy) / camera.fy, cx = camera.cx, fx = camera.fx;
    const float *X = here, *Y = here + W, *Z = here + 2 * W;
    const float *OX = above, *OY = above + W, *OZ = above + 2 * W;
    const float *UX = below, *UY = below + W, *UZ = below + 2 * W;
    for (int x = 1; x < W - 1; ++x) {
        const float z = Z[x], l = Z[x - 1], r = Z[x + 1], o = OZ[x], u = UZ[x];
        const float ax = X[x + 1] - X[x - 1], ay = Y[x + 1] - Y[x - 1], az = r - l;
        const float bx = UX[x] - OX[x], by = UY[x] - OY[x], bz = u - o;
        const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
        const float shortest = footprint * z * z;
        const float rx = ((float)x - cx) / fx;
        const float met = (nx * X[x] + ny * Y[x] + nz * z) / (nx * rx + ny * ry + nz);
        const bool measured = (z > 0) & (l > 0) & (r > 0) & (o > 0) & (u > 0);
        const bool across = same_surface(l, z, r), down = same_surface(o, z, u);
        const bool plane = across & down & (nx * nx + ny * ny + nz * nz >= shortest * shortest);
        // The intersection with a plane nearly parallel to the ray is not reliable.
        const bool close = std::fabs(met - z) < MAX_SURFACE_CORRECTION * z;
        depth[x] = (measured & plane & close) ? met : z;
    }
}

}  // namespace

// Front-to-back compositing gives the nearer of two overlapping Gaussians more weight. On a slanted
// surface, the mean depth is therefore that of a point up to half a pixel away from the ray. The mean
// of the centres is on the surface, so the depth is computed by intersecting the ray with the plane
// through it.
void surface_depth(const Pinhole& camera, const double* T, const float* images, const float* centres,
                   float min_silhouette, float* depth) {
    const int W = camera.width, H = camera.height, bands = (H + BAND - 1) / BAND;
    const MeanCentres means(camera, T, images, centres, min_silhouette);
#pragma omp parallel for schedule(static)
    for (int band = 0; band < bands; ++band) {
        std::vector<float> rows[3];
        for (auto& row : rows) row.resize(3 * (size_t)W);
        const int first = band * BAND, end = std::min(H, first + BAND);
        if (first > 0) means.row(first - 1, rows[(first + 2) % 3].data());
        means.row(first, rows[first % 3].data());
        for (int y = first; y < end; ++y) {
            const float* here = rows[y % 3].data();
            if (y + 1 < H) means.row(y + 1, rows[(y + 1) % 3].data());
            std::copy_n(here + 2 * W, W, depth + (size_t)y * W);
            if (y == 0 || y == H - 1) continue;
            intersect(camera, y, rows[(y + 2) % 3].data(), here, rows[(y + 1) % 3].data(), depth + (size_t)y * W);
        }
    }
}

}  // namespace semsplat
