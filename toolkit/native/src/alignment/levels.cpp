// Derivatives and planes of a model view, and the next pyramid level of a frame.
#include "alignment/levels.hpp"

#include <algorithm>
#include <cmath>

#include "rendering/surface.hpp"

namespace semsplat {

void build_model_level(const Pinhole& camera, const float* intensity, const float* depth, float* texture,
                       float* surface) {
    const int W = camera.width, H = camera.height;
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            const size_t i = (size_t)y * W + x;
            float* out = texture + 4 * i;
            float* normal = surface + 4 * i;
            std::fill_n(out, 4, 0.0f);
            std::fill_n(normal, 4, 0.0f);
            if (x == 0 || y == 0 || x == W - 1 || y == H - 1) continue;
            const float z = depth[i], l = depth[i - 1], r = depth[i + 1], o = depth[i - W], u = depth[i + W];
            if (!(std::min(std::min(std::min(z, l), std::min(r, o)), u) > 0)) continue;
            out[0] = intensity[i];
            out[1] = 0.5f * (intensity[i + 1] - intensity[i - 1]);
            out[2] = 0.5f * (intensity[i + W] - intensity[i - W]);
            out[3] = z;
            if (!same_surface(l, z, r) || !same_surface(o, z, u)) continue;
            // Tangents along x and y: d/dx of ((x - cx) / fx z, (y - cy) / fy z, z).
            const float rx = (x - camera.cx) / camera.fx, ry = (y - camera.cy) / camera.fy;
            const float zx = 0.5f * (r - l), zy = 0.5f * (u - o);
            const float ax = z / camera.fx + rx * zx, ay = ry * zx, az = zx;
            const float bx = rx * zy, by = z / camera.fy + ry * zy, bz = zy;
            float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
            const float length = std::sqrt(nx * nx + ny * ny + nz * nz);
            nx /= length;
            ny /= length;
            nz /= length;
            normal[0] = nx;
            normal[1] = ny;
            normal[2] = nz;
            normal[3] = (nx * rx + ny * ry + nz) * z;
        }
    }
}

void halve(int width, int height, const float* intensity, const float* depth, float max_difference,
           float* half_intensity, float* half_depth) {
    const int W = std::max(1, width / 2), H = std::max(1, height / 2);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            const int x1 = std::min(2 * x + 1, width - 1), y1 = std::min(2 * y + 1, height - 1);
            const size_t taps[4] = {(size_t)(2 * y) * width + 2 * x, (size_t)(2 * y) * width + x1,
                                    (size_t)y1 * width + 2 * x, (size_t)y1 * width + x1};
            float sum = 0, surface_sum = 0, nearest = 1e30f, inverse = 0;
            int count = 0;
            for (size_t tap : taps) {
                sum += intensity[tap];
                if (depth[tap] > 0) nearest = std::min(nearest, depth[tap]);
            }
            // Average the nearest surface only, without pixels across an edge or without depth.
            for (size_t tap : taps) {
                if (depth[tap] > 0 && depth[tap] - nearest <= max_difference * nearest) {
                    surface_sum += intensity[tap];
                    inverse += 1.0f / depth[tap];
                    ++count;
                }
            }
            half_intensity[(size_t)y * W + x] = count ? surface_sum / count : 0.25f * sum;
            half_depth[(size_t)y * W + x] = count ? count / inverse : 0.0f;
        }
    }
}

}  // namespace semsplat
