// Derivatives and planes of a model view, and the next pyramid level of a frame. The loops over the
// pixels of a row have no branches, so that the compiler vectorises them.
#include "alignment/levels.hpp"

#include <algorithm>
#include <cmath>

#include "rendering/surface.hpp"

namespace semsplat {

namespace {

// Texture and surface [W, 4] of the inner pixels of a row. intensity, depth: of the row, inside the image.
void model_row(const Pinhole& camera, int y, const float* intensity, const float* depth, float* __restrict texture,
               float* __restrict surface) {
    const int W = camera.width;
    const float fx = camera.fx, fy = camera.fy, cx = camera.cx, ry = ((float)y - camera.cy) / fy;
    const float *above = depth - W, *below = depth + W, *i_above = intensity - W, *i_below = intensity + W;
    for (int x = 1; x < W - 1; ++x) {
        const float z = depth[x], l = depth[x - 1], r = depth[x + 1], o = above[x], u = below[x];
        const bool measured = (z > 0) & (l > 0) & (r > 0) & (o > 0) & (u > 0);
        const float across = 0.5f * (intensity[x + 1] - intensity[x - 1]), down = 0.5f * (i_below[x] - i_above[x]);
        texture[4 * x] = measured ? intensity[x] : 0.0f;
        texture[4 * x + 1] = measured ? across : 0.0f;
        texture[4 * x + 2] = measured ? down : 0.0f;
        texture[4 * x + 3] = measured ? z : 0.0f;
        // Tangents along x and y: d/dx of ((x - cx) / fx z, (y - cy) / fy z, z).
        const float rx = ((float)x - cx) / fx;
        const float zx = 0.5f * (r - l), zy = 0.5f * (u - o);
        const float ax = z / fx + rx * zx, ay = ry * zx, az = zx;
        const float bx = rx * zy, by = z / fy + ry * zy, bz = zy;
        const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
        const float inverse = 1.0f / std::sqrt(nx * nx + ny * ny + nz * nz);
        const float offset = (nx * rx + ny * ry + nz) * z;
        const bool along_row = same_surface(l, z, r), along_column = same_surface(o, z, u);
        const bool plane = measured & along_row & along_column;
        surface[4 * x] = plane ? nx * inverse : 0.0f;
        surface[4 * x + 1] = plane ? ny * inverse : 0.0f;
        surface[4 * x + 2] = plane ? nz * inverse : 0.0f;
        surface[4 * x + 3] = plane ? offset * inverse : 0.0f;
    }
}

}  // namespace

void build_model_level(const Pinhole& camera, const float* intensity, const float* depth, float* texture,
                       float* surface) {
    const int W = camera.width, H = camera.height;
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        const size_t start = (size_t)y * W;
        float *texels = texture + 4 * start, *planes = surface + 4 * start;
        const bool border = y == 0 || y == H - 1;
        for (float* row : {texels, planes}) {
            std::fill_n(row, border ? 4 * W : 4, 0.0f);
            std::fill_n(row + 4 * (W - 1), 4, 0.0f);
        }
        if (!border) model_row(camera, y, intensity + start, depth + start, texels, planes);
    }
}

namespace {

// One row of the next level from two rows. RIGHT: offset of a cell's second column.
template <int RIGHT>
void halve_rows(int width, const float* const (&intensity)[2], const float* const (&depth)[2], float max_difference,
                float* __restrict half_intensity, float* __restrict half_depth) {
    const float *i0 = intensity[0], *i1 = intensity[1], *d0 = depth[0], *d1 = depth[1];
    for (int x = 0; x < width; ++x) {
        const float i[4] = {i0[2 * x], i0[2 * x + RIGHT], i1[2 * x], i1[2 * x + RIGHT]};
        const float d[4] = {d0[2 * x], d0[2 * x + RIGHT], d1[2 * x], d1[2 * x + RIGHT]};
        float nearest = 1e30f, sum = 0, surface_sum = 0, inverse = 0, count = 0;
        for (int k = 0; k < 4; ++k) nearest = d[k] > 0 ? std::min(nearest, d[k]) : nearest;
        // Average the nearest surface only, without pixels across an edge or without depth.
        for (int k = 0; k < 4; ++k) {
            const bool near = (d[k] > 0) & (d[k] - nearest <= max_difference * nearest);
            sum += i[k];
            surface_sum += near ? i[k] : 0.0f;
            inverse += near ? 1.0f / d[k] : 0.0f;
            count += near ? 1.0f : 0.0f;
        }
        half_intensity[x] = count > 0 ? surface_sum / count : 0.25f * sum;
        half_depth[x] = count > 0 ? count / inverse : 0.0f;
    }
}

}  // namespace

void halve(int width, int height, const float* intensity, const float* depth, float max_difference,
           float* half_intensity, float* half_depth) {
    const int W = std::max(1, width / 2), H = std::max(1, height / 2);
    const auto rows = width > 1 ? halve_rows<1> : halve_rows<0>;
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        const size_t upper = (size_t)(2 * y) * width, lower = (size_t)std::min(2 * y + 1, height - 1) * width;
        rows(W, {intensity + upper, intensity + lower}, {depth + upper, depth + lower}, max_difference,
             half_intensity + (size_t)y * W, half_depth + (size_t)y * W);
    }
}

}  // namespace semsplat
