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
        : camera_(camera), images_(images), centres_(centres), min_silhouette_(min_silhouette),
          plane_((size_t)camera.width * camera.height) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R_[3 * i + j] = (float)T[4 * i + j];
            t_[i] = (float)T[4 * i + 3];
        }
    }

    bool solid(size_t i) const { return images_[SILHOUETTE * plane_ + i] >= min_silhouette_; }

    // Zero where the silhouette is below the minimum, and at edges, where the offset is large.
    void at(int x, int y, float& across, float& down) const {
        across = down = 0.0f;
        const size_t i = (size_t)y * camera_.width + x;
        if (!solid(i)) return;
        const float inverse = 1.0f / images_[SILHOUETTE * plane_ + i];
        const float a = centres_[i] * inverse, b = centres_[plane_ + i] * inverse,
                    c = centres_[2 * plane_ + i] * inverse;
        const float z = R_[6] * a + R_[7] * b + R_[8] * c + t_[2];
        if (!(z > MIN_CENTRE_DEPTH_M)) return;
        const float u = camera_.fx * (R_[0] * a + R_[1] * b + R_[2] * c + t_[0]) / z + camera_.cx - x;
        const float v = camera_.fy * (R_[3] * a + R_[4] * b + R_[5] * c + t_[1]) / z + camera_.cy - y;
        if (!(std::fabs(u) <= MAX_CENTRE_OFFSET_PX && std::fabs(v) <= MAX_CENTRE_OFFSET_PX)) return;
        across = u;
        down = v;
    }

private:
    const Pinhole& camera_;
    const float *images_, *centres_;
    float min_silhouette_, R_[9], t_[3];
    size_t plane_;
};

}  // namespace

void centred_intensity(const Pinhole& camera, const double* T, const float* images, const float* centres,
                       float min_silhouette, float* intensity) {
    const int W = camera.width, H = camera.height;
    std::vector<float> rendered((size_t)W * H);
    intensity_of(camera, images, min_silhouette, rendered.data());
    const CentreOffsets offsets(camera, T, images, centres, min_silhouette);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            const size_t i = (size_t)y * W + x;
            intensity[i] = rendered[i];
            if (x == 0 || y == 0 || x == W - 1 || y == H - 1 || !offsets.solid(i)) continue;
            // Next to a hole, the derivatives would be those of its border.
            if (!(offsets.solid(i - 1) && offsets.solid(i + 1) && offsets.solid(i - W) && offsets.solid(i + W)))
                continue;
            float across, down;
            offsets.at(x, y, across, down);
            intensity[i] -= 0.5f * (rendered[i + 1] - rendered[i - 1]) * across;
            intensity[i] -= 0.5f * (rendered[i + W] - rendered[i - W]) * down;
        }
    }
}

void texture_at_centres(const Pinhole& camera, const double* T, const float* images, const float* centres,
                        float min_silhouette, const float* rgb, float* out) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    const CentreOffsets offsets(camera, T, images, centres, min_silhouette);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            float across, down;
            offsets.at(x, y, across, down);
            const float u = std::min(std::max(x + across, 0.0f), (float)(W - 1));
            const float v = std::min(std::max(y + down, 0.0f), (float)(H - 1));
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

}  // namespace semsplat
