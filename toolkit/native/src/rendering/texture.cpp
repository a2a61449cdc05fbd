// Colours of a rendered view at the projections of the mean centres of the Gaussians.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "rendering/surface.hpp"

namespace semsplat {

void intensity_of(const Pinhole& camera, const float* images, float min_silhouette, float* intensity) {
    const int64_t plane = (int64_t)camera.width * camera.height;
    const float *r = images, *g = images + plane, *b = images + 2 * plane, *s = images + SILHOUETTE * plane;
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < plane; ++i) {
        // Not divided by the silhouette, because mapping fits composited colours. Otherwise, the
        // difference would accumulate in the exposure of successive keyframes.
        const float luma = LUMA_RED * r[i] + LUMA_GREEN * g[i] + LUMA_BLUE * b[i];
        intensity[i] = s[i] >= min_silhouette ? luma : 0.0f;
    }
}

namespace {

// Offsets from pixels to the projections of the mean centres of the Gaussians.
class CentreOffsets {
public:
    CentreOffsets(const Pinhole& camera, const double* T, const float* images, const float* centres,
                  float min_silhouette)
        : camera_(camera), silhouette_(images + SILHOUETTE * (size_t)camera.width * camera.height),
          centres_(centres), min_silhouette_(min_silhouette) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R_[3 * i + j] = (float)T[4 * i + j];
            t_[i] = (float)T[4 * i + 3];
        }
    }

    // The offsets [W] of a row: zero where the silhouette is below the minimum, and at edges, where the
    // offset is large. Without branches, so that the compiler vectorises the loop.
    void row(int y, float* __restrict across, float* __restrict down) const {
        const int W = camera_.width;
        const size_t plane = (size_t)W * camera_.height, start = (size_t)y * W;
        const float *s = silhouette_ + start, *a = centres_ + start, *b = a + plane, *c = b + plane;
        const float fx = camera_.fx, fy = camera_.fy, cx = camera_.cx, cy = camera_.cy - (float)y;
        const float least = min_silhouette_;
        for (int x = 0; x < W; ++x) {
            const float inverse = 1.0f / s[x], p = a[x] * inverse, q = b[x] * inverse, r = c[x] * inverse;
            const float z = R_[6] * p + R_[7] * q + R_[8] * r + t_[2];
            const float u = fx * (R_[0] * p + R_[1] * q + R_[2] * r + t_[0]) / z + cx - (float)x;
            const float v = fy * (R_[3] * p + R_[4] * q + R_[5] * r + t_[1]) / z + cy;
            const float offset = std::max(std::fabs(u), std::fabs(v));
            const bool usable = (s[x] >= least) & (z > MIN_CENTRE_DEPTH_M) & (offset <= MAX_CENTRE_OFFSET_PX);
            across[x] = usable ? u : 0.0f;
            down[x] = usable ? v : 0.0f;
        }
    }

private:
    Pinhole camera_;
    const float *silhouette_, *centres_;
    float min_silhouette_, R_[9], t_[3];
};

// Moves the intensity of the inner pixels of a row by offsets. red, silhouette: of the row, inside images.
void move_row(int W, size_t plane, const float* red, const float* silhouette, float min_silhouette,
              const float* across, const float* down, float* __restrict intensity) {
    const float *green = red + plane, *blue = green + plane;
    const float *r0 = red - W, *g0 = green - W, *b0 = blue - W, *s0 = silhouette - W;
    const float *r1 = red + W, *g1 = green + W, *b1 = blue + W, *s1 = silhouette + W;
    for (int x = 1; x < W - 1; ++x) {
        const float dx = LUMA_RED * (red[x + 1] - red[x - 1]) + LUMA_GREEN * (green[x + 1] - green[x - 1]) +
                         LUMA_BLUE * (blue[x + 1] - blue[x - 1]);
        const float dy = LUMA_RED * (r1[x] - r0[x]) + LUMA_GREEN * (g1[x] - g0[x]) + LUMA_BLUE * (b1[x] - b0[x]);
        const float change = 0.5f * (dx * across[x] + dy * down[x]);
        // Next to a hole, the derivatives would be those of its border.
        const bool solid = (silhouette[x] >= min_silhouette) & (silhouette[x - 1] >= min_silhouette) &
                           (silhouette[x + 1] >= min_silhouette) & (s0[x] >= min_silhouette) &
                           (s1[x] >= min_silhouette);
        intensity[x] -= solid ? change : 0.0f;
    }
}

}  // namespace

void centred_intensity(const Pinhole& camera, const double* T, const float* images, const float* centres,
                       float min_silhouette, float* intensity) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    intensity_of(camera, images, min_silhouette, intensity);
    const CentreOffsets offsets(camera, T, images, centres, min_silhouette);
#pragma omp parallel
    {
        std::vector<float> across((size_t)W), down((size_t)W);
#pragma omp for schedule(static)
        for (int y = 1; y < H - 1; ++y) {
            const size_t start = (size_t)y * W;
            offsets.row(y, across.data(), down.data());
            move_row(W, plane, images + start, images + SILHOUETTE * plane + start, min_silhouette, across.data(),
                     down.data(), intensity + start);
        }
    }
}

void texture_at_centres(const Pinhole& camera, const double* T, const float* images, const float* centres,
                        float min_silhouette, const float* rgb, float* out) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    const CentreOffsets offsets(camera, T, images, centres, min_silhouette);
#pragma omp parallel
    {
        std::vector<float> across((size_t)W), down((size_t)W);
#pragma omp for schedule(static)
        for (int y = 0; y < H; ++y) {
            offsets.row(y, across.data(), down.data());
            for (int x = 0; x < W; ++x) {
                const float u = std::min(std::max((float)x + across[x], 0.0f), (float)(W - 1));
                const float v = std::min(std::max((float)y + down[x], 0.0f), (float)(H - 1));
                const int left = std::max(0, std::min((int)u, W - 2)), top = std::max(0, std::min((int)v, H - 2));
                const int right = std::min(left + 1, W - 1), below = std::min(top + 1, H - 1);
                const float a = u - left, b = v - top;
                for (int k = 0; k < 3; ++k) {
                    const float* image = rgb + k * plane;
                    const float *upper = image + (size_t)top * W, *lower = image + (size_t)below * W;
                    out[k * plane + (size_t)y * W + x] = (upper[left] * (1 - a) + upper[right] * a) * (1 - b) +
                                                         (lower[left] * (1 - a) + lower[right] * a) * b;
                }
            }
        }
    }
}

}  // namespace semsplat
