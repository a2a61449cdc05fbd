// Colours of a rendered view at the projections of the mean centres of the Gaussians.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "rendering/mean_centres.hpp"
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

// Offsets from the pixels of a row to the projections of the mean centres of the Gaussians. Each thread
// has its own.
class CentreOffsets {
public:
    std::vector<float> across, down;

    CentreOffsets(const Pinhole& camera, const MeanCentres& centres)
        : across((size_t)camera.width), down((size_t)camera.width), camera_(camera), centres_(centres),
          points_(3 * (size_t)camera.width) {}

    // Offsets are zero where the silhouette is below the minimum, and at edges, where they are large.
    // Without branches, so that the compiler vectorises the loop.
    void move_to(int y) {
        centres_.row(y, points_.data());
        const int W = camera_.width;
        const float *X = points_.data(), *Y = X + W, *Z = Y + W;
        const float fx = camera_.fx, fy = camera_.fy, cx = camera_.cx, cy = camera_.cy - (float)y;
        float *__restrict to_across = across.data(), *__restrict to_down = down.data();
        for (int x = 0; x < W; ++x) {
            const float u = fx * X[x] / Z[x] + cx - (float)x, v = fy * Y[x] / Z[x] + cy;
            const float offset = std::max(std::fabs(u), std::fabs(v));
            const bool usable = (Z[x] > MIN_CENTRE_DEPTH_M) & (offset <= MAX_CENTRE_OFFSET_PX);
            to_across[x] = usable ? u : 0.0f;
            to_down[x] = usable ? v : 0.0f;
        }
    }

private:
    const Pinhole& camera_;
    const MeanCentres& centres_;
    std::vector<float> points_;
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
    const MeanCentres means(camera, T, images, centres, min_silhouette);
#pragma omp parallel
    {
        CentreOffsets offsets(camera, means);
#pragma omp for schedule(static)
        for (int y = 1; y < H - 1; ++y) {
            const size_t start = (size_t)y * W;
            offsets.move_to(y);
            move_row(W, plane, images + start, images + SILHOUETTE * plane + start, min_silhouette,
                     offsets.across.data(), offsets.down.data(), intensity + start);
        }
    }
}

void texture_at_centres(const Pinhole& camera, const double* T, const float* images, const float* centres,
                        float min_silhouette, const float* rgb, float* out) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    const MeanCentres means(camera, T, images, centres, min_silhouette);
#pragma omp parallel
    {
        CentreOffsets offsets(camera, means);
#pragma omp for schedule(static)
        for (int y = 0; y < H; ++y) {
            offsets.move_to(y);
            for (int x = 0; x < W; ++x) {
                const float u = std::min(std::max((float)x + offsets.across[x], 0.0f), (float)(W - 1));
                const float v = std::min(std::max((float)y + offsets.down[x], 0.0f), (float)(H - 1));
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
